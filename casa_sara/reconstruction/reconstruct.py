"""From whitened visibilities to a model image: operators, bounds and solver put together, without CASA."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from casa_sara.data.distribution import Layout
from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.parallel.partition import ALONE, RankAssignment
from casa_sara.reconstruction.bootstrap import jackknife_groups
from casa_sara.reconstruction.checkpoint import Checkpoint
from casa_sara.reconstruction.draws import FEWEST, Draws
from casa_sara.reconstruction.flat_noise import FlatNoise
from casa_sara.reconstruction.paper_method import PAPER
from casa_sara.reconstruction.problem import Problem, Samples, averaging_cell
from casa_sara.reconstruction.result import Reconstruction
from casa_sara.reconstruction.settings import check_l2bound, operator_accuracy, schedule_of
from casa_sara.reconstruction.solution import begin, begin_draws, resume
from casa_sara.reconstruction.state_file import digest, digest_on_disk
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.dabbech2018 import run_paper_algorithm_2
from casa_sara.solver.islands import add_flux_errors
from casa_sara.solver.record import CONVERGED, NOISE_ONLY, SolverRecord
from casa_sara.solver.reweighting import Steps, algorithm_2, stepped

__all__ = ["Control", "reconstruct", "reconstruction_steps"]

NOISE_ONLY_RELTOL = 0.1  # what little noise leaves need not settle
ERRORS_OF_ISLANDS = dict(draws="bootstrap_error_jy", jackknife="jackknife_error_jy")


@dataclass(frozen=True)
class Control:
    """How a solution is followed, ended and kept.

    Attributes
    ----------
    progress : callable
        Called after every iteration with (ppd, record): see :func:`casa_sara.solver.reweighting.run_algorithm_2`.
    stopped : callable
        Asked after every iteration; True ends the solution with what there is. It ends the NNLS fit too, and one
        iteration follows.
    checkpoint : Checkpoint, optional
        Keeps the state now and then; where it holds a `state` that was read, the solution goes on from that. A solution
        whose NNLS fit was cut short is not kept: it is not on the way to the same image. Only rank 0 reads and writes
        it.
    tell : callable
        Takes a line for the log.
    drawn : callable
        Called with 'jackknife' and its `Draws`, then with 'draws' and those of the bootstrap: before the first one of
        each, and after every one.
    then : callable, optional
        Called at the end with the iteration, its bounds and its record, all as the solution has left them.
    """

    progress: Callable[[AdaptivePPD, SolverRecord], None] = lambda ppd, record: None
    stopped: Callable[[], bool] = lambda: False
    checkpoint: Checkpoint | None = None
    tell: Callable[[str], None] = lambda line: None
    drawn: Callable[[str, Draws], None] = lambda name, draws: None
    then: Callable[[AdaptivePPD, Any, SolverRecord], None] | None = None


def reconstruct(samples: Samples, grid: ImageGrid, options: SolverOptions, startmodel: np.ndarray | None = None,
                control: Control = Control(), support: np.ndarray | None = None,
                ranks: RankAssignment = ALONE) -> Reconstruction:
    """Find the SARA image of block-sorted visibilities.

    Parameters
    ----------
    samples : Samples
        With the sampling density, and the noise where it is known.
    grid : ImageGrid
        Size, pixels, direction and gridder of the image.
    options : SolverOptions
        Task parameters of the method.
    startmodel : real (nx, ny), optional
        First image, Jy/pixel. It and `support` are stacked where there are outliers:
        :func:`casa_sara.operators.outliers.stacked`.
    control : Control
        What ends the solution early, and keeps its state.
    support : bool (nx, ny), optional
        The model is exactly 0 elsewhere.
    ranks : RankAssignment
        The ranks that share the work: `samples` are this rank's part, all else is the same on all.

    Returns
    -------
    Reconstruction

    Raises
    ------
    ValueError
        Noise levels that are neither one for all blocks nor one for each; too few blocks for a jackknife; errors
        asked for with the paper's method; total power with errors, with bounds that do not adapt, or on several ranks;
        outliers with errors, with the paper's method, or on several ranks.
    CheckpointError
        The state that was read is not one of these data.
    """
    found: Reconstruction = stepped(reconstruction_steps(samples, grid, options, startmodel, control, support, ranks))
    return found


def reconstruction_steps(samples: Samples, grid: ImageGrid, options: SolverOptions,
                         startmodel: np.ndarray | None = None, control: Control = Control(),
                         support: np.ndarray | None = None, ranks: RankAssignment = ALONE) -> Steps:
    """Yield the iteration and its bounds before each of its steps, which are for the caller to take: `reconstruct`.

    Parameters
    ----------
    samples, grid, options, startmodel, control, support, ranks
        As of :func:`reconstruct`.

    Returns
    -------
    Reconstruction
    """
    comm, checkpoint = ranks.comm, control.checkpoint
    _check(options, grid, samples, comm)
    flat = FlatNoise.of(samples.data, grid, comm)
    if flat is not None:
        grid, support, startmodel = flat.grid(grid), flat.support(support), flat.image(startmodel)
    # images in units of the noise of one sample: every number is near 1
    unit_jy = float(comm.mean(samples.data.weight, dtype=float) ** -0.5)
    problem_of = partial(Problem.of, grid=grid, options=options, unit_jy=unit_jy, support=support, comm=comm,
                         eps=operator_accuracy(samples.data, samples.offsets, samples.noise, comm))
    layout = Layout(samples.offsets, comm)
    if checkpoint is not None:
        _identify(checkpoint, samples, layout, grid, support, comm)
    if checkpoint is not None and comm.bcast(checkpoint.state is not None):
        solution = resume(samples, layout, problem_of, options, checkpoint, ranks)
    else:
        solution = begin(samples, problem_of, options, startmodel, control.stopped, ranks)
        if control.stopped():
            control = replace(control, checkpoint=None)
    sides = averaging_cell(grid)
    averaging = _averaging(solution, sides)
    control.tell(_averaging_words(solution.ppd, averaging, options, grid, sides))
    if solution.result is None:
        yield from _solve(solution, samples, averaging, options, control, layout, ranks)
    for name, resampling in solution.resamplings.items():
        if not _draw(solution, name, resampling, control, layout, ranks):
            break
    assert solution.result is not None
    return solution.result if flat is None else flat.of_sky(solution.result)


def _solve(solution, samples, averaging, options, control, layout, ranks):
    """Run the solution to its end, and make ready for what follows it."""
    record = yield from _iterate(solution, options, control, layout, ranks)
    begin_draws(solution, record, options)
    goes_on = bool(solution.resamplings or control.then)
    solution.result = _result(solution, record, samples, averaging, ranks.comm, goes_on)
    if goes_on:  # with averages that are exact for its model
        solution.ppd.renew_averages(solution.ppd.model)
    if control.then:
        control.then(solution.ppd, solution.bounds, record)


def _check(options, grid, samples, comm):
    """Raise where options, image and data do not go together."""
    blocks = len(samples.offsets) - 1
    if samples.total_power is not None:
        _check_total_power(options, comm)
    check_l2bound(options, blocks)
    if grid.outliers:
        _check_outliers(options, comm)
    if options.jackknife:
        jackknife_groups(blocks)
    if (options.ndraws or options.jackknife) and options.method == PAPER:
        raise ValueError(f"ndraws = {options.ndraws}, jackknife = {options.jackknife}: should be 0 and False with "
                         f"method = '{PAPER}', which has no errors of the model")


def _check_total_power(options, comm):
    """Raise where there cannot be a single dish beside the visibilities."""
    wrong = dict(databound=options.databound != "adapt", method=options.method == PAPER, ndraws=options.ndraws > 0,
                 jackknife=options.jackknife, parallel=comm.size > 1)
    for name in (name for name, is_wrong in wrong.items() if is_wrong):
        raise ValueError(f"{name} = {getattr(options, name, True)!r} is not possible with total power")


def _check_outliers(options, comm):
    """Raise where there cannot be outliers beside the image."""
    wrong = dict(method=options.method == PAPER, ndraws=options.ndraws > 0, jackknife=options.jackknife,
                 parallel=comm.size > 1)
    for name in (name for name, is_wrong in wrong.items() if is_wrong):
        raise ValueError(f"{name} = {getattr(options, name, True)!r} is not possible with outliers")


def _averaging(solution, sides):
    """Return what is kept of the averaging, as of `Reconstruction`."""
    ppd, found = solution.ppd, solution.found
    if ppd.averaged is None:
        return {}
    averages, enlarged = int(ppd.block_sizes[:len(found.finer)].sum()), min(0, int(found.finer.min()))
    return dict(averages=averages, halvings=(found.finer - enlarged).tolist(),
                cell_wavelengths=[float(side) * 2.0**-enlarged for side in (sides[1], sides[0])],
                largest_error=found.averaging_error)


def _averaging_words(ppd, averaging, options, grid, sides):
    """Return the line of the log on it."""
    cell = f"uv cells of {sides[1]:.4g} x {sides[0]:.4g} wavelengths"
    within = "block" if grid.mosaic is None else "block, pointing and kind of baseline"
    if averaging:
        smaller = 2 ** max(averaging["halvings"])
        finer = f", or up to {smaller} times smaller" if smaller > 1 else ""
        u, v = averaging["cell_wavelengths"]
        cell = f"uv cells of {u:.4g} x {v:.4g} wavelengths"
        count = ppd.samples[:len(averaging["halvings"])].sum()
        return (f"{count} visibilities are averaged to {averaging['averages']} for the solver, within each "
                f"{within} and {cell}{finer}; for the first image the averages are wrong by up to "
                f"{averaging['largest_error']:.2g} of their noise, which is corrected at every re-weighting")
    if not options.averages:
        return f"visibilities are not averaged: method = '{options.method}', databound = '{options.databound}'"
    return f"visibilities are not averaged: {cell} would leave more than half as many"


def _identify(checkpoint, samples, layout, grid, support, comm):
    """Tell the checkpoint, on rank 0, of what data the solution is: digests of all that it depends on."""
    data = samples.data
    gathered = dict(visibilities=data.vis, weights=data.weight, uvw=data.uvw, density=samples.density)
    beams = None
    if grid.mosaic is not None:
        gathered["beam"] = np.asarray(data.beam)
        beams = np.array([[*one.centre, one.radius_rad, *one.profile] for one in grid.mosaic.beams], np.float32)
    digests: dict[str, str | None] = {
        name: digest(whole) for name, array in gathered.items() if not data.scratch.on_disk
        and (whole := layout.gather(np.ascontiguousarray(array))) is not None}
    if data.scratch.on_disk:
        digests |= {name: digest_on_disk(array, data.scratch) for name, array in gathered.items()}
    spectralindex = grid.spectrum and np.asarray(grid.spectrum.index)
    subbands = grid.subbands and grid.subbands.freqs_hz
    digests |= {name: None if array is None else digest(np.asarray(array)) for name, array in dict(
        blocks=layout.offsets, noise=samples.noise, support=support, spectralindex=spectralindex, subbands=subbands,
        beams=beams,
        sdimage=samples.total_power and samples.total_power.values).items()}
    comm.once(checkpoint.identify, **digests)


def _iterate(solution, options, control, layout, ranks):
    """Run Algorithm 2 to its end, keeping the state now and then; return the record."""
    schedule: Any = schedule_of(options)
    if solution.found.noise_only:
        schedule = replace(schedule, final_reltol=max(schedule.final_reltol, NOISE_ONLY_RELTOL))
    keep = partial(_keep, solution, control.checkpoint, layout, ranks)
    ppd, bounds, stage = solution.ppd, solution.bounds, solution.stage
    if options.method == PAPER:
        return run_paper_algorithm_2(ppd, bounds, schedule, control.progress, control.stopped, keep, stage)
    return (yield from algorithm_2(ppd, bounds, schedule, control.progress, control.stopped, keep, stage))


def _draw(solution, name, resampling, control, layout, ranks):
    """Make the draws of one kind, keeping the state, and add the errors of islands; return whether all are made."""
    draws = resampling.draws
    drawn = partial(control.drawn, name)
    drawn(draws)
    resampling.run(control.stopped, drawn, partial(_keep, solution, control.checkpoint, layout, ranks, None))
    if len(draws) >= FEWEST:
        planes = solution.ppd.planes
        seen = draws if planes.n_planes == 1 else draws.seen(planes.difference_at_reference)
        add_flux_errors(solution.result.record.islands, planes.at_reference(resampling.model), seen.flux_errors,
                        ERRORS_OF_ISLANDS[name])
    return draws.complete


def _keep(solution, checkpoint, layout, ranks, stage, now):
    """Write the checkpoint if there is one and its time has come, or `now`."""
    if checkpoint is None:
        return
    comm, iteration = ranks.comm, solution.ppd.iteration
    if comm.size == 1:
        checkpoint.keep(lambda: solution.state(stage, layout, ranks), iteration, now)
    elif comm.bcast_numbers([checkpoint.due(now)])[0]:  # then all ranks take part in gathering the state
        state = solution.state(stage, layout, ranks)
        comm.once(checkpoint.keep, lambda: state, iteration, now=True)


def _result(solution, record, samples, averaging, comm, goes_on):
    """Return what was found, in Jy; the iteration keeps its model where it `goes_on`."""
    found, ppd, bounds, unit_jy = solution.found, solution.ppd, solution.bounds, solution.ppd.unit_jy
    resamplings = solution.resamplings
    model = ppd.model.copy() if goes_on else comm.own(ppd.model)
    if record.stop_code == CONVERGED and (found.noise_only or not model.any()):
        record.stop_code = NOISE_ONLY
    model *= np.float32(unit_jy)
    subbands = solution.subbands
    blocks = len(samples.offsets) - 1
    total_power = {}
    if solution.dish is not None:
        whitened = dict(noise=bounds.l2_bounds, residual=ppd.residual_norms, alone=found.nnls_norms)
        values = samples.total_power.values
        brightest = float(np.abs(values).max())
        total_power = dict(points=values.size, brightest_jy_per_beam=brightest) | {
            f"{name}_jy_per_beam": float(norms[-1] / np.sqrt(2 * ppd.samples[-1]) / solution.dish.scale)
            for name, norms in whitened.items()}
    return Reconstruction(
        np.ascontiguousarray(ppd.planes.at_reference(model)), bounds.l2_bounds[:blocks],
        ppd.residual_norms[:blocks].copy(), found.nnls_norms[:blocks], record,
        data_norm_sq=found.data_norm_sq / unit_jy**2, threshold=ppd.threshold * unit_jy,
        noise_jy_per_beam=unit_jy * bounds.total_weight**-0.5, kept=np.delete(samples.kept, found.left_out),
        wild=found.wild, averaging=averaging, total_power=total_power,
        spectra=None if subbands is None else subbands.spectra(model),
        outliers=[image.copy() for image in ppd.planes.looked_at(model)[1:]],
        **{name: resampling.draws for name, resampling in resamplings.items()})


