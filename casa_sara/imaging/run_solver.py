"""The solution of one image within a run: density of the uv coverage, progress, time limit, checkpoint, outliers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial

import numpy as np

from casa_sara.casa.images.products import CHECKPOINT
from casa_sara.casa.ms.weights import sampling_density
from casa_sara.casa.runtime import log
from casa_sara.data.visibilities import BlockInfo, Visibilities, clock
from casa_sara.imaging.time_forecast import Pace
from casa_sara.operators.beams import mosaic_density
from casa_sara.options import ImageGrid, ImagingRequest, Selection, SolverOptions
from casa_sara.parallel.partition import ALONE, RankAssignment
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.reconstruction.bootstrap import DRAW_ITERATIONS, MOST_GROUPS
from casa_sara.reconstruction.checkpoint import Checkpoint
from casa_sara.reconstruction.draws import FEWEST
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.reconstruct import Control, reconstruct
from casa_sara.reconstruction.result import Reconstruction
from casa_sara.reconstruction.settings import schedule_of
from casa_sara.runtime.deadline import Deadline
from casa_sara.runtime.signals import stop_on_interrupt
from casa_sara.solver.nnls import NNLS_ITERATIONS
from casa_sara.solver.record import CONVERGED, ITERATION_LIMIT, STOPPED_BY_USER, TIME_LIMIT, UNFINISHED
from casa_sara.version import __version__

__all__ = ["Preparing", "Watch", "at_odds", "checkpoint_of", "density_of", "expected_iterations", "log_end",
           "show_progress", "solve_image", "without_wild"]

AT_ODDS, OF_BRIGHTEST = 3.0, 0.01  # times what a single dish alone leaves, and of its brightest point: a warning
MOST_NAMED = 20  # wild samples that the log names one by one


@dataclass
class Watch:
    """When a solution has to end, how long an iteration takes, where its state is kept, or was, and what is done then.

    `then` is called as `Control.then`, with what tells whether to stop before the rest.
    """

    deadline: Deadline = field(default_factory=Deadline)
    pace: Pace | None = None
    checkpoint: Checkpoint | None = None
    then: Callable[..., None] | None = None


def checkpoint_of(request: ImagingRequest) -> Checkpoint:
    """Return the checkpoint of a run, with the task parameters on which the model depends.

    Where the data are is none of them (they are known by their contents), nor is how many threads there are.
    """
    output = request.output
    startmodel = output.startmodel if output.startmodel != output.imagename + ".model" else ""  # that of restart = True
    parameters = asdict(request.selection) | asdict(request.grid) | asdict(request.options)
    parameters |= dict(blocks=output.blocks, startmodel=startmodel)
    parameters["imsize"], parameters["cell"] = parameters.pop("shape"), parameters.pop("cell_rad")
    if request.grid.outliers:
        parameters["outlierfile"] = [
            dict(imsize=one.grid.shape, cell=one.grid.cell_rad, phasecenter=one.grid.phasecenter,
                 usemask=one.grid.usemask, mask=one.grid.mask, pbmask=one.grid.pbmask,
                 startmodel=one.startmodel if one.startmodel != one.imagename + ".model" else "")
            for one in request.grid.outliers]
    for name in ("vis", "nthreads", "spectrum", "mosaic", "subbands", "outliers"):
        del parameters[name]
    return Checkpoint(output.imagename + CHECKPOINT, __version__, parameters, log.info, log.warn)


def density_of(data: Visibilities, selection: Selection | None, grid: ImageGrid, options: SolverOptions,
               comm: Serial = SERIAL) -> np.ndarray:
    """Return the sampling density of each sample, real (M,): 1 where no preconditioner is asked for.

    Parameters
    ----------
    data : Visibilities
        The samples.
    selection : Selection or None
        That gave the data; None where they are but a part of it.
    grid : ImageGrid
        Size, pixels, direction and gridder of the image.
    options : SolverOptions
        Task parameters of the method.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.
    """
    if not options.precondition:
        return np.ones(data.size, np.float32)
    log.info("computing the density of the uv coverage")
    if grid.mosaic is not None:
        return mosaic_density(data.uvw, data.beam, data.imaging_weight, grid.mosaic, comm)
    return sampling_density(data, selection, grid, comm)


def solve_image(samples: Samples, grid: ImageGrid, options: SolverOptions, startmodel: np.ndarray | None = None,
                watch: Watch | None = None, support: np.ndarray | None = None,
                ranks: RankAssignment = ALONE) -> Reconstruction:
    """Reconstruct block-sorted visibilities, with progress in the log, Ctrl-C as the wish to stop, and time as a limit.

    Parameters
    ----------
    samples : Samples
        With the sampling density (:func:`density_of`) and the noise.
    grid : ImageGrid
        Size, pixels, direction and gridder of the image.
    options : SolverOptions
        Task parameters of the method.
    startmodel : float32 (nx, ny), optional
        First model, Jy/pixel; it and `support` are stacked where there are outliers.
    watch : Watch, optional
        Without it there is no limit of time and no checkpoint.
    support : bool (nx, ny), optional
        The model is 0 elsewhere.
    ranks : casa_sara.parallel.partition.RankAssignment
        The ranks that share the work; rank 0 decides when to stop.

    Returns
    -------
    Reconstruction
    """
    progress = log.Progress()
    preparing = Preparing(progress)
    report = partial(show_progress, progress, preparing, schedule_of(options).expected_iterations,
                     watch.pace if watch else None, ("", 0, 1))
    with stop_on_interrupt() as pressed:
        def stopped():
            preparing()
            return bool(ranks.comm.bcast_numbers([pressed() or bool(watch and watch.deadline.near())])[0])

        then = watch and watch.then
        control = Control(report, stopped, watch.checkpoint if watch else None, log.info, _Drawing(progress, preparing),
                          then and partial(then, stopped))
        if not (control.checkpoint and control.checkpoint.state is not None):
            progress.prepare("computing the norm of the measurement operator, and the first image by non-negative "
                             f"least squares (NNLS, {NNLS_ITERATIONS} iterations; repeated when outliers are found)")
        reconstruction = reconstruct(samples, grid, options, startmodel, control, support, ranks)
    progress.close()
    record = reconstruction.record
    if record.stop_code == STOPPED_BY_USER and not ranks.comm.bcast(pressed()):
        record.stop_code = TIME_LIMIT
    log_end(reconstruction, samples.offsets, control.checkpoint, ranks.comm)
    for draws, what in ((reconstruction.jackknife, "groups of the jackknife"), (reconstruction.draws, "draws")):
        if draws is not None:
            _log_draws(draws, what, control.checkpoint)
    return reconstruction


def expected_iterations(options: SolverOptions) -> int:
    """A guess of the iterations of a run: those of the solution and those of the draws."""
    draws = options.ndraws + options.jackknife * MOST_GROUPS
    return schedule_of(options).expected_iterations + draws * DRAW_ITERATIONS


def show_progress(progress, preparing, expected, pace, place, ppd, record):
    """Show how far the solution is, after every iteration of `expected` ones.

    Parameters
    ----------
    progress : log.Progress
        Shows it.
    preparing : Preparing
        What was shown before the first iteration.
    expected : int
        Iterations.
    pace : callable or None
        Takes the iterations that are done, and returns a line for the log, or nothing.
    place : (str, int, int)
        What is solved for, where there are several, with ': ', its number, and how many there are.
    ppd : AdaptivePPD
        The iteration.
    record : SolverRecord
        Its history.
    """
    name, number, count = place
    preparing.over = True
    begun = record.resumed[-1] if record.resumed else 0
    if pace and (line := pace(ppd.iteration - begun)):
        log.info(line)
    fraction = min((ppd.iteration - begun) / max(expected - begun, 1), 0.999)
    progress(ppd.iteration,
             f"{name}reduced chi-square {_reduced(record.residual_norm[-1], ppd.samples.sum()):.4g}, "
             f"model flux {record.model_flux[-1]:.5g} Jy, relative change of the model {ppd.rel_change:.1e}, "
             f"{record.reweighting[-1]} re-weightings", (number + fraction) / count)


def log_end(reconstruction, offsets, checkpoint=None, comm=SERIAL):
    """Write to the log why the solution ended and what it found.

    Parameters
    ----------
    reconstruction : Reconstruction
        The solution.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1] of the samples given.
    checkpoint : Checkpoint, optional
        That a restart continues from.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.
    """
    record = reconstruction.record
    say = log.info if record.stop_code in (CONVERGED, ITERATION_LIMIT, STOPPED_BY_USER) else log.warn
    samples = _samples_of_blocks(reconstruction, offsets, comm)
    say(f"{record.stop_description}, after {record.iteration[-1]} iterations and {record.reweighting[-1]} "
        f"re-weightings: reduced chi-square {_reduced(record.residual_norm[-1], samples.sum()):.4g}, model flux "
        f"{record.model_flux[-1]:.5g} Jy")
    if checkpoint and checkpoint.stands and record.stop_code in UNFINISHED:
        log.info(f"restart = True continues from '{checkpoint.path}'")
    released = sum(update["released"] for update in record.reweightings)
    if released:
        log.info(f"{released} pixels near unresolved sources were allowed to be negative, because the sources lie "
                 "between pixel centres")
    _log_total_power(reconstruction.total_power)
    for j, (bound, norm) in enumerate(zip(reconstruction.l2_bounds, reconstruction.residual_norms)):
        log.info(f"block {j}: noise found {_reduced(bound, samples[j]) ** 0.5:#.3g} x MS weights, "
                 f"reduced chi-square {_reduced(norm, samples[j]):.4g}")


def _log_total_power(found):
    """Write to the log what became of a single dish, {} where there is none; warn where it is at odds with the rest."""
    if not found:
        return
    log.info("total power: noise found {noise_jy_per_beam:#.3g} Jy/beam, rms of the residual "
             "{residual_jy_per_beam:#.3g} Jy/beam at {points} points".format(**found))
    if at_odds(found):
        log.warn("sdimage and vis are at odds: the rms of what the model leaves of sdimage is "
                 "{residual_jy_per_beam:.3g} Jy/beam, of what an image of sdimage alone leaves {alone_jy_per_beam:.3g} "
                 "Jy/beam. Their flux scales may differ (sdgain), or their positions, or the beam of sdimage"
                 .format(**found))


def at_odds(found: dict[str, float]) -> bool:
    """Return whether a single dish and the visibilities contradict each other.

    Parameters
    ----------
    found : dict
        `total_power` of :class:`casa_sara.reconstruction.result.Reconstruction`.
    """
    least = max(AT_ODDS * found["alone_jy_per_beam"], OF_BRIGHTEST * found["brightest_jy_per_beam"])
    return found["residual_jy_per_beam"] > least


class _Drawing:
    """The progress of jackknife and bootstrap, after every draw."""

    WORDS = {"draws": "bootstrap: draw", "jackknife": "jackknife: group"}

    def __init__(self, progress, preparing):
        self._progress, self._preparing = progress, preparing

    def __call__(self, name, draws):
        """Say how many draws are made; before the first one, too."""
        self._preparing.over = True
        self._progress.draw(self.WORDS[name], len(draws), draws.asked)


def _log_draws(draws, name, checkpoint):
    """Write to the log what became of the bootstrap, or of the jackknife."""
    if not draws.asked:
        log.info(f"no {name}: the model is empty")
    elif draws.complete:
        log.info(f"errors of the model follow from {len(draws)} {name}")
    else:
        what = "errors follow from these" if len(draws) >= FEWEST else "no errors follow from so few"
        stands = checkpoint and checkpoint.stands
        log.warn(f"{len(draws)} of {draws.asked} {name} were made before the run was stopped: {what}"
                 + (f"; restart = True makes the others, from '{checkpoint.path}'" if stands else ""))


class Preparing:
    """The progress of the NNLS fit, which is asked after every iteration whether to stop.

    Attributes
    ----------
    over : bool
        The iterations of the solver have begun.
    """

    INTERVAL = 3.0  # s between two lines of the log

    def __init__(self, progress, clock=time.monotonic):
        self._progress, self._clock, self._iteration, self.over = progress, clock, 0, False
        self._last = clock()

    def __call__(self):
        """Count one more iteration."""
        if self.over:
            return
        self._iteration += 1
        due = self._clock() - self._last >= self.INTERVAL
        if due:
            self._last = self._clock()
        self._progress.prepare(f"NNLS iteration {self._iteration}", due)


def _reduced(norm, samples):
    """Return χ²/2M, the reduced chi-square of M complex samples, of the norm of their whitened residual."""
    return float(norm) ** 2 / (2.0 * max(int(samples), 1))


def _samples_of_blocks(reconstruction, offsets, comm):
    """Return the number of samples in use of every block, int (d,), on all ranks together."""
    return comm.allreduce(np.diff(np.searchsorted(reconstruction.kept, offsets)))


def without_wild(data: Visibilities, blocks: list[BlockInfo], offsets: np.ndarray, reconstruction: Reconstruction,
                 comm: Serial = SERIAL) -> tuple[Visibilities, list[BlockInfo]]:
    """Leave out the outliers that the reconstruction left out, and list them in the log.

    Parameters
    ----------
    data : Visibilities
        The samples.
    blocks : list of d BlockInfo
        The blocks.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    reconstruction : Reconstruction
        The solution, which names the samples that it has left out.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    data : Visibilities
    blocks : list of d BlockInfo
    """
    wild = reconstruction.wild
    if not wild:
        return data, blocks
    log.warn(f"{len(wild)} outliers, visibilities that no sky can explain, are left out:")
    for one in wild[:MOST_NAMED]:
        log.warn(f"  {one['ms']} row {one['row']}, spw {one['spw']}, channel {one['channel']}, antennas "
                 f"{one['antenna1']} and {one['antenna2']}, {clock(one['time_mjd_s'])}: {one['amplitude_jy']:.4g} Jy "
                 f"where the model has {one['predicted_jy']:.4g} Jy")
    if len(wild) > MOST_NAMED:
        log.warn(f"  … and {len(wild) - MOST_NAMED} more, which the record lists as 'wild'")
    samples = _samples_of_blocks(reconstruction, offsets, comm)
    blocks = [replace(block, samples=int(count)) for block, count in zip(blocks, samples)]
    return replace(data.take(reconstruction.kept), dropped=data.dropped | {"wild": len(wild)}), blocks
