"""The solution of one image within a run: sampling density, progress, limits of time, checkpoint, wild samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial

import numpy as np

import casa_sara
from casa_sara.casa import log
from casa_sara.casa.catalogue import located
from casa_sara.casa.imageplane import ImagePlane
from casa_sara.casa.products import CHECKPOINT
from casa_sara.casa.weights import sampling_density
from casa_sara.deadline import Deadline
from casa_sara.interrupt import stop_on_interrupt
from casa_sara.options import ImageGrid, Output, Selection, SolverOptions
from casa_sara.parallel import SERIAL, Serial
from casa_sara.problem import Samples
from casa_sara.reconstruction import Control, Reconstruction, reconstruct, schedule_of
from casa_sara.sharing import ALONE, Crew
from casa_sara.solver.checkpoint import Checkpoint
from casa_sara.solver.islands import STRUCTURE
from casa_sara.solver.record import CONVERGED, ITERATION_LIMIT, STOPPED_BY_USER, TIME_LIMIT, UNFINISHED, SolverRecord
from casa_sara.timing import Pace
from casa_sara.visibilities import BlockInfo, Visibilities, clock

__all__ = ["Watch", "checkpoint_of", "density_of", "list_islands", "solve_image", "without_wild"]

MOST_NAMED = 20  # wild samples that the log names one by one
MOST_TOLD = 20  # islands of emission that the log lists


@dataclass
class Watch:
    """When a solution has to end, how long an iteration takes, and where its state is kept, or was."""

    deadline: Deadline
    pace: Pace
    checkpoint: Checkpoint


def checkpoint_of(selection: Selection, grid: ImageGrid, options: SolverOptions, output: Output) -> Checkpoint:
    """Return the checkpoint of a run, which knows the parameters that decide the model, by the names of the task.

    Where the data are is none of them (they are known by their contents), nor is how many threads there are.
    """
    startmodel = output.startmodel if output.startmodel != output.imagename + ".model" else ""  # that of restart = True
    parameters = asdict(selection) | asdict(grid) | asdict(options) | dict(blocks=output.blocks, startmodel=startmodel)
    parameters["imsize"], parameters["cell"] = parameters.pop("shape"), parameters.pop("cell_rad")
    for name in ("vis", "nthreads", "spectrum"):
        del parameters[name]
    return Checkpoint(output.imagename + CHECKPOINT, casa_sara.__version__, parameters, log.info, log.warn)


def density_of(data: Visibilities, selection: Selection | None, grid: ImageGrid, options: SolverOptions,
               comm: Serial = SERIAL) -> np.ndarray:
    """Return the sampling density of each sample, real (M,): 1 where no preconditioner is asked for.

    Parameters
    ----------
    data : Visibilities
    selection : Selection or None
        That gave the data; None where they are but a part of it.
    grid : ImageGrid
    options : SolverOptions
    comm : casa_sara.parallel.Serial or MPI
        Over whose ranks the samples are spread.
    """
    return sampling_density(data, selection, grid, comm) if options.precondition else np.ones(data.size, np.float32)


def solve_image(samples: Samples, grid: ImageGrid, options: SolverOptions, startmodel: np.ndarray | None = None,
                watch: Watch | None = None, support: np.ndarray | None = None, crew: Crew = ALONE) -> Reconstruction:
    """Reconstruct block-sorted visibilities, with progress in the log, Ctrl-C as the wish to stop, and time as a limit.

    Parameters
    ----------
    samples : Samples
        With the sampling density (:func:`density_of`) and the noise.
    grid : ImageGrid
    options : SolverOptions
    startmodel : float32 (nx, ny), optional
        First model, Jy/pixel.
    watch : Watch, optional
        Without it there is no limit of time and no checkpoint.
    support : bool (nx, ny), optional
        The model is 0 elsewhere.
    crew : casa_sara.sharing.Crew
        The ranks that share the work; rank 0 decides when to stop.

    Returns
    -------
    Reconstruction
    """
    progress = log.Progress()
    report = partial(_report, progress, schedule_of(options).expected_iterations, watch.pace if watch else None)
    with stop_on_interrupt() as pressed:
        def stopped():
            return bool(crew.comm.lead([pressed() or bool(watch and watch.deadline.near())])[0])

        control = Control(report, stopped, watch.checkpoint if watch else None)
        reconstruction = reconstruct(samples, grid, options, startmodel, control, support, crew)
    progress.close()
    record = reconstruction.record
    if record.stop_code == STOPPED_BY_USER and not crew.comm.broadcast(pressed()):
        record.stop_code = TIME_LIMIT
    _tell_end(reconstruction, control.checkpoint)
    return reconstruction


def _report(progress: log.Progress, expected: int, pace: Callable[[int], str] | None, ppd, record):
    """Show how far the solution is, after every iteration of `expected` ones."""
    begun = record.resumed[-1] if record.resumed else 0
    if pace and (words := pace(ppd.iteration - begun)):
        log.info(words)
    fraction = min((ppd.iteration - begun) / max(expected - begun, 1), 0.999)
    progress(ppd.iteration, f"{record.reweighting[-1]} re-weightings, relative change {ppd.rel_change:.1e}, "
             f"flux {record.model_flux[-1]:.5g} Jy, residual norm {record.residual_norm[-1]:.5g}", fraction)


def _tell_end(reconstruction, checkpoint):
    """Say in the log why the solution ended and what it found."""
    record = reconstruction.record
    say = log.info if record.stop_code in (CONVERGED, ITERATION_LIMIT, STOPPED_BY_USER) else log.warn
    say(f"{record.stop_description}: {record.iteration[-1]} iterations, {record.reweighting[-1]} re-weightings")
    if checkpoint and checkpoint.stands and record.stop_code in UNFINISHED:
        log.info(f"restart = True goes on from '{checkpoint.path}'")
    released = sum(update["released"] for update in record.reweightings)
    if released:
        log.info(f"{released} pixels beside unresolved sources were allowed to be negative: the sources are between pixels")
    for j, (bound, norm) in enumerate(zip(reconstruction.l2_bounds, reconstruction.residual_norms)):
        log.info(f"block {j}: l2 bound {bound:.5g}, residual {norm:.5g} (whitened)")


def without_wild(data: Visibilities, blocks: list[BlockInfo], offsets: np.ndarray, reconstruction: Reconstruction,
                 comm: Serial = SERIAL) -> tuple[Visibilities, list[BlockInfo]]:
    """Leave out what the reconstruction left out, and say what that was.

    Parameters
    ----------
    data : Visibilities
    blocks : list of d BlockInfo
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    reconstruction : Reconstruction
    comm : casa_sara.parallel.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    data : Visibilities
    blocks : list of d BlockInfo
    """
    wild = reconstruction.wild
    if not wild:
        return data, blocks
    log.warn(f"{len(wild)} wild samples, which no sky explains, are left out:")
    for one in wild[:MOST_NAMED]:
        log.warn(f"  {one['ms']} row {one['row']}, spw {one['spw']}, channel {one['channel']}, antennas "
                 f"{one['antenna1']} and {one['antenna2']}, {clock(one['time_mjd_s'])}: {one['amplitude_jy']:.4g} Jy where "
                 f"the image has {one['predicted_jy']:.4g} Jy")
    if len(wild) > MOST_NAMED:
        log.warn(f"  … and {len(wild) - MOST_NAMED} more, in the record's 'wild'")
    samples = comm.sum(np.diff(np.searchsorted(reconstruction.kept, offsets)))
    blocks = [replace(block, samples=int(count)) for block, count in zip(blocks, samples)]
    return replace(data.take(reconstruction.kept), dropped=data.dropped | {"wild": len(wild)}), blocks


def list_islands(record: SolverRecord, plane: ImagePlane, cell_rad: tuple[float, float], significance: float,
                 comm: Serial = SERIAL) -> None:
    """Give the islands of a model their places on the sky, list them in the log, and say whether the residual is noise.

    Parameters
    ----------
    record : SolverRecord
        Its islands are given `right_ascension` and `declination` (text, in the frame of the image) and `fwhm_arcsec`.
    plane : ImagePlane
    cell_rad : (float, float)
        Pixel size.
    significance : float
        That was asked for.
    comm : casa_sara.parallel.Serial or MPI
        Ranks that share the work.
    """
    record.islands = comm.once(located, record.islands, plane, cell_rad)
    _tell(record, significance)


def _tell(record, significance):
    if not record.residual_snr:
        return
    islands = record.islands
    if not islands:
        log.info(f"no emission of {significance:g} sigma or more: the model is empty")
    else:
        log.info(f"{len(islands)} islands of emission of {significance:g} sigma or more"
                 + (f", the {MOST_TOLD} most significant:" if len(islands) > MOST_TOLD else ":"))
    for island in islands[:MOST_TOLD]:
        log.info(f"  {island['right_ascension']} {island['declination']}: {island['flux_jy']:.4g} +- "
                 f"{island['flux_error_jy']:.2g} Jy, S/N {island['snr']:.3g}, FWHM {island['fwhm_arcsec']:.3g} arcsec")
    worst = max((peak for peak in record.residual_snr if peak["beams"] >= 1), key=lambda peak: peak["snr"], default=None)
    if worst and worst["snr"] > STRUCTURE:
        log.warn(f"the residual is not noise: it reaches {worst['snr']:.3g} sigma when smoothed to {worst['beams']:g} beams; "
                 "calibration errors, emission outside the image, or emission that the model cannot hold")
