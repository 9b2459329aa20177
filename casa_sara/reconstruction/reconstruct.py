"""From whitened visibilities to a model image: operators, bounds and solver put together, without CASA."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from casa_sara.data.distribution import Layout
from casa_sara.data.visibilities import Visibilities
from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.operators.measurement import SMALLEST_EPS, choose_eps
from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.parallel.partition import ALONE, RankAssignment
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.reconstruction.bootstrap import Bootstrap, Jackknife, jackknife_groups
from casa_sara.reconstruction.checkpoint import Checkpoint
from casa_sara.reconstruction.draws import FEWEST, Draws
from casa_sara.reconstruction.flat_noise import FlatNoise
from casa_sara.reconstruction.paper_method import PAPER, block_norms, first_threshold, paper_bounds, paper_iteration
from casa_sara.reconstruction.problem import DYNAMIC_RANGE, Findings, Problem, Samples, averaging_cell, first_image
from casa_sara.reconstruction.state_file import digest
from casa_sara.solver.adaptive_ppd import BASIS_ARRAYS, SAMPLE_ARRAYS, AdaptivePPD
from casa_sara.solver.dabbech2018 import PaperBounds, PaperSchedule, PaperStage, run_paper_algorithm_2
from casa_sara.solver.islands import add_flux_errors
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds, chi_square_bounds
from casa_sara.solver.record import CONVERGED, DIVERGED, NOISE_ONLY, UNFINISHED, SolverRecord
from casa_sara.solver.reweighting import Schedule, Stage, run_algorithm_2
from casa_sara.solver.significance import SignificantSupport

__all__ = ["Control", "Reconstruction", "check_l2bound", "operator_accuracy", "reconstruct", "schedule_of"]

STEP_BALANCE = 0.15  # κ in units of the mean brightness Σx²/Σ|x| of the first model
NOISE_ONLY_SNR = 5.0
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


@dataclass
class Reconstruction:
    """A solved image.

    Attributes
    ----------
    model : float32 (nx, ny)
        Jy/pixel.
    l2_bounds, residual_norms : float (d,)
        ε_j and μ_j, whitened.
    nnls_norms : float (d,)
        μ_j of the NNLS image, from which adaptive bounds start.
    record : SolverRecord
    data_norm_sq : float
        ‖U^½Φ‖², whitened, 1/Jy².
    threshold : float
        Last κ, Jy/pixel.
    noise_jy_per_beam : float
        Noise of the naturally weighted dirty image for the noise levels found.
    kept : int (M',)
        Samples that were used, numbers into the data given.
    wild : list of dict
        The others, named: see :class:`casa_sara.data.outliers.WildSamples`.
    averaging : dict
        `averages` to which these samples were averaged, `cell_wavelengths` (u, v) of the largest uv cells, `halvings`
        of each block's, and the `largest_error` of the averages of the first image in units of their noise; empty where
        they were not.
    draws, jackknife : Draws or None
        Of the bootstrap and of the jackknife, where asked for and the solution has come to an end.
    """

    model: np.ndarray
    l2_bounds: np.ndarray
    residual_norms: np.ndarray
    nnls_norms: np.ndarray
    record: SolverRecord
    data_norm_sq: float
    threshold: float
    noise_jy_per_beam: float
    kept: np.ndarray
    wild: list[dict]
    averaging: dict
    draws: Draws | None = None
    jackknife: Draws | None = None

    @classmethod
    def of(cls, state: dict[str, Any]) -> Reconstruction:
        """Make it of its attributes as a checkpoint has them.

        Parameters
        ----------
        state : dict
            Attributes by name, the record as of :meth:`SolverRecord.state`.

        Returns
        -------
        Reconstruction
        """
        record = SolverRecord()
        record.set_state(state["record"])
        values: dict[str, Any] = {name: np.array(value) if isinstance(value, np.ndarray) else value
                                  for name, value in state.items()}
        return cls(**values | dict(record=record))

    @property
    def finished(self) -> bool:
        """Whether a restart would have nothing to continue."""
        drawn = [draws for draws in (self.jackknife, self.draws) if draws is not None]
        return self.record.stop_code not in UNFINISHED and all(draws.complete for draws in drawn)


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
        First image, Jy/pixel.
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
        Noise levels that are neither one for all blocks nor one for each; too few blocks for a jackknife.
    CheckpointError
        The state that was read is not one of these data.
    """
    comm, checkpoint = ranks.comm, control.checkpoint
    _check_blocks(options, len(samples.offsets) - 1)
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
        solution = _resume(samples, layout, problem_of, options, checkpoint, ranks)
    else:
        solution = _begin(samples, problem_of, options, startmodel, control.stopped, ranks)
        if control.stopped():
            control = replace(control, checkpoint=None)
    averaging = _averaging(solution, averaging_cell(grid))
    control.tell(_averaging_words(solution.ppd, averaging, options, grid))
    if solution.result is None:
        _solve(solution, samples, averaging, options, control, layout, ranks)
    for name, resampling in solution.resamplings.items():
        if not _draw(solution, name, resampling, control, layout, ranks):
            break
    return solution.result if flat is None else flat.of_sky(solution.result)


def _solve(solution, samples, averaging, options, control, layout, ranks):
    """Run the solution to its end, and make ready for what follows it."""
    record = _iterate(solution, options, control, layout, ranks)
    _begin_draws(solution, record, options)
    goes_on = bool(solution.resamplings or control.then)
    solution.result = _result(solution, record, samples, averaging, ranks.comm, goes_on)
    if goes_on:  # with averages that are exact for its model
        solution.ppd.renew_averages(solution.ppd.model)
    if control.then:
        control.then(solution.ppd, solution.bounds, record)


def _check_blocks(options, blocks):
    """Raise where options and number of blocks do not go together."""
    check_l2bound(options, blocks)
    if options.jackknife:
        jackknife_groups(blocks)


def _averaging(solution, sides):
    """Return what is kept of the averaging, as of `Reconstruction`."""
    ppd, found = solution.ppd, solution.found
    if ppd.averaged is None:
        return {}
    return dict(averages=int(ppd.block_sizes.sum()), cell_wavelengths=[float(sides[1]), float(sides[0])],
                halvings=found.finer.tolist(), largest_error=found.averaging_error)


def _averaging_words(ppd, averaging, options, grid):
    """Return the line of the log on it."""
    sides = averaging_cell(grid)
    cell = f"uv cells of {sides[1]:.4g} x {sides[0]:.4g} wavelengths"
    if averaging:
        smaller = 2 ** max(averaging["halvings"])
        finer = f", or up to {smaller} times smaller" if smaller > 1 else ""
        return (f"{ppd.samples.sum()} visibilities are averaged to {averaging['averages']}, within each block and "
                f"{cell}{finer}: the averages of the first image are wrong by up to "
                f"{averaging['largest_error']:.2g} of their noise, which is put right at every re-weighting")
    if options.averages and grid.mosaic is not None:
        return "visibilities are not averaged: gridder = 'mosaic'"
    if options.averages:
        return f"visibilities are not averaged: more than half of them would be left by {cell}"
    return f"visibilities are not averaged: method = '{options.method}', databound = '{options.databound}'"


def _identify(checkpoint, samples, layout, grid, support, comm):
    """Tell the checkpoint, on rank 0, of what data the solution is: digests of all that it depends on."""
    data = samples.data
    gathered = dict(visibilities=data.vis, weights=data.weight, uvw=data.uvw, density=samples.density)
    digests: dict[str, str | None] = {
        name: digest(whole) for name, array in gathered.items()
        if (whole := layout.gather(np.ascontiguousarray(array))) is not None}
    spectralindex = grid.spectrum and np.asarray(grid.spectrum.index)
    digests |= {name: None if array is None else digest(np.asarray(array)) for name, array in dict(
        blocks=layout.offsets, noise=samples.noise, support=support, spectralindex=spectralindex,
        sensitivity=grid.mosaic and grid.mosaic.over).items()}
    comm.once(checkpoint.identify, **digests)


def _iterate(solution, options, control, layout, ranks):
    """Run Algorithm 2 to its end, keeping the state now and then; return the record."""
    schedule = schedule_of(options)
    if solution.found.noise_only:
        schedule = replace(schedule, final_reltol=max(schedule.final_reltol, NOISE_ONLY_RELTOL))
    run: Callable[..., SolverRecord] = run_paper_algorithm_2 if options.method == PAPER else run_algorithm_2
    keep = partial(_keep, solution, control.checkpoint, layout, ranks)
    return run(solution.ppd, solution.bounds, schedule, control.progress, control.stopped, keep, solution.stage)


def _begin_draws(solution, record, options):
    """Make ready for the draws, once the solution has come to an end; an empty model has no errors to draw."""
    ppd, blocks = solution.ppd, len(solution.bounds.l2_bounds)
    if record.stop_code in (*UNFINISHED, DIVERGED):
        return
    scale = record.reweightings[-1]["scale"] if record.reweightings else 0.0
    for name, kind, asked in (("jackknife", Jackknife, jackknife_groups(blocks) if options.jackknife else 0),
                              ("draws", Bootstrap, options.ndraws)):
        if asked:
            draws = Draws(ppd.model.shape, asked if ppd.model.any() else 0)
            solution.resamplings[name] = kind(ppd, solution.bounds, _support(options), scale, ppd.model.copy(),
                                              ppd.threshold, draws)


def _support(options):
    """Return the support of a solution that has found one, None where nothing confines the model."""
    confined = options.significance > 0 and options.nreweights > 0
    return SignificantSupport(options.significance, begun=True) if confined else None


def _draw(solution, name, resampling, control, layout, ranks):
    """Make the draws of one kind, keeping the state, and add the errors of islands; return whether all are made."""
    draws = resampling.draws
    drawn = partial(control.drawn, name)
    drawn(draws)
    resampling.run(control.stopped, drawn, partial(_keep, solution, control.checkpoint, layout, ranks, None))
    if len(draws) >= FEWEST:
        add_flux_errors(solution.result.record.islands, resampling.model, draws.flux_errors, ERRORS_OF_ISLANDS[name])
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
    return Reconstruction(
        model, bounds.l2_bounds, ppd.residual_norms.copy(), found.nnls_norms, record,
        data_norm_sq=found.data_norm_sq / unit_jy**2, threshold=ppd.threshold * unit_jy,
        noise_jy_per_beam=unit_jy * bounds.total_weight**-0.5, kept=np.delete(samples.kept, found.left_out),
        wild=found.wild, averaging=averaging,
        **{name: resampling.draws for name, resampling in resamplings.items()})


@dataclass
class _Solution:
    """The iteration of a problem with its bounds, begun or gone on with."""

    found: Findings
    ppd: AdaptivePPD
    bounds: AdaptiveBounds | GivenBounds | PaperBounds
    stage: Stage | PaperStage | None = None
    result: Reconstruction | None = None
    resamplings: dict[str, Bootstrap] = field(default_factory=dict)

    @classmethod
    def of(cls, problem, found, options, ranks):
        """Put it together, at the very beginning."""
        measurement, samples = problem.measurement, problem.samples
        dictionary = SaraDictionary(measurement.shape, ranks.wavelets(options.wavelets), options.wavelevels,
                                    nthreads=options.nthreads, n_bases=len(options.wavelets))
        if options.method == PAPER:
            ppd = paper_iteration(problem, dictionary, found.data_norm_sq, options.positivity)
        else:
            ppd = AdaptivePPD(measurement, dictionary, problem.vis, problem.offsets, problem.precond,
                              found.data_norm_sq, options.positivity, comm=ranks.comm)
        ppd.unit_jy, ppd.averaged, ppd.sky_over_image = problem.unit_jy, problem.averaged, problem.sky_over_image
        ppd.samples = ranks.comm.exscan(np.diff(samples.offsets))[1]
        if problem.support is not None:
            ppd.confine(problem.support)
        weights = samples.data.weight * np.float32(problem.unit_jy**2)
        weight_sums = ranks.comm.block_sums(weights, samples.offsets)
        return cls(found, ppd, _bounds(ppd, found.nnls_norms, weight_sums, samples.noise, options))

    def state(self, stage, layout, ranks):
        """Return, on rank 0, all that :func:`_resume` needs beside data and parameters, as one rank alone has it."""
        left_out = np.concatenate(ranks.comm.allgather(layout.numbers(self.found.left_out)))
        found = vars(self.found) | dict(left_out=np.sort(left_out))
        ppd, kept = self.ppd.state(), Layout(self.ppd.offsets, ranks.comm)
        ppd |= {name: kept.gather(ppd[name]) for name in SAMPLE_ARRAYS}
        ppd |= {name: ranks.gather_bases(ppd[name]) for name in BASIS_ARRAYS}
        state = dict(found=found, ppd=ppd, bounds=self.bounds.state())
        if self.result is None:
            return state | dict(stage=stage.state())
        result = vars(self.result) | dict(record=self.result.record.state(), kept=None, draws=None, jackknife=None)
        return state | dict(result=result, resamplings={name: one.state() for name, one in self.resamplings.items()})


def _begin(samples, problem_of, options, startmodel, stopped, ranks):
    """Leave out wild samples, and begin from the first image or from `startmodel`."""
    problem, found, first = first_image(samples, problem_of, options, stopped, ranks.comm)
    if startmodel is not None:
        startmodel = startmodel / np.float32(problem.unit_jy)
        if problem.support is not None:
            startmodel *= problem.support
    if options.method == PAPER:
        found.nnls_norms = block_norms(problem, problem_of, options, stopped)
        solution = _Solution.of(problem, found, options, ranks)
        model = np.zeros_like(first) if startmodel is None else startmodel
        threshold = first_threshold(options, first)
    else:
        solution = _Solution.of(problem, found, options, ranks)
        found.noise_only = _is_noise_only(solution.ppd, solution.bounds)
        model = first if startmodel is None else startmodel
        threshold = STEP_BALANCE * _mean_brightness(model)
    solution.ppd.start_from(model)
    solution.ppd.rescale(threshold)
    return solution


def _resume(samples, layout, problem_of, options, checkpoint, ranks):
    """Go on from the state that rank 0 has read."""
    with checkpoint.applied(ranks.comm.rank == 0) as state:
        state = _plain_state(state, ranks.comm)
        values: dict[str, Any] = {name: np.array(value) if isinstance(value, np.ndarray) else value
                                  for name, value in state["found"].items()}
        found = Findings(**values)
        found.left_out = layout.here(found.left_out)
        problem = problem_of(samples.without(found.left_out), data_norm_sq=found.data_norm_sq, finer=found.finer)
        solution = _Solution.of(problem, found, options, ranks)
        ppd, kept = state["ppd"], Layout(solution.ppd.offsets, ranks.comm)
        ppd |= {name: kept.scatter(ppd[name]) for name in SAMPLE_ARRAYS}
        ppd |= {name: ranks.scatter_bases(ppd[name]) for name in BASIS_ARRAYS}
        solution.ppd.set_state(ppd)
        solution.bounds.set_state(state["bounds"])
        if "resamplings" in state:
            kept = np.delete(samples.kept, found.left_out)
            _resume_draws(solution, options, state["result"] | dict(kept=kept), state["resamplings"])
        else:
            solution.stage = (PaperStage if options.method == PAPER else Stage).of(state["stage"])
            solution.ppd.renew_averages(solution.stage.previous)
    return solution


def _resume_draws(solution, options, result, states):
    """Take over the result, and the draws so far."""
    solution.result = Reconstruction.of(result)
    for name, state in states.items():
        draws = Draws.of(state["draws"])
        setattr(solution.result, name, draws)
        kind, model = Jackknife if name == "jackknife" else Bootstrap, np.array(state["model"])
        solution.resamplings[name] = kind(solution.ppd, solution.bounds, _support(options), state["scale"], model,
                                          state["threshold"], draws, state["done"])
        solution.ppd.renew_averages(model)


def check_l2bound(options: SolverOptions, blocks: int) -> None:
    """Raise ValueError where the noise levels given are not one for all blocks, or one for each.

    Parameters
    ----------
    options : SolverOptions
        Task parameters of the method.
    blocks : int
        d.
    """
    if options.databound == "fixed" and len(options.l2bound) not in (1, blocks):
        raise ValueError(f"l2bound = {list(options.l2bound)}: there are {blocks} blocks; give one noise level "
                         "for all of them, or one for each")


def _plain_state(state, comm):
    """Return the state with all that every rank needs whole; what is spread over them stays on rank 0."""
    if comm.size == 1:
        return state
    spread = {name: state["ppd"].pop(name) for name in (*SAMPLE_ARRAYS, *BASIS_ARRAYS)} if comm.rank == 0 else {}
    state = comm.bcast(state)
    return state | dict(ppd=state["ppd"] | {name: spread.get(name) for name in (*SAMPLE_ARRAYS, *BASIS_ARRAYS)})


def operator_accuracy(data: Visibilities, offsets: np.ndarray, noise: np.ndarray | None,
                      comm: Serial = SERIAL) -> float:
    """What accuracy the operator needs for these data, by the noise measured in them; the best where that is unknown.

    Parameters
    ----------
    data : Visibilities
        The samples.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    noise : float (d,) or None
        Noise of each block relative to the MS weights.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    float
    """
    if noise is None or not np.all(np.asarray(noise) > 0):
        return SMALLEST_EPS[np.dtype(np.float32)]
    level = np.repeat(np.asarray(noise, np.float32), np.diff(offsets))
    return choose_eps(data.vis, data.weight / level**2, comm=comm)


def schedule_of(options: SolverOptions) -> Schedule | PaperSchedule:
    """The solver's schedule for these task parameters.

    Parameters
    ----------
    options : SolverOptions
        Task parameters of the method.

    Returns
    -------
    Schedule or PaperSchedule
    """
    if options.method == PAPER:
        return PaperSchedule.of(options)
    return Schedule(options.niter, options.nreweights, options.reweightdecay, options.reweighttol,
                    options.reltol, options.finalreltol, significance=options.significance)


def _bounds(ppd, nnls_norms, weight_sums, noise, options):
    samples = ppd.samples
    if options.method == PAPER:
        return paper_bounds(ppd, nnls_norms, weight_sums, options)
    common = dict(samples=samples, weight_sums=weight_sums, n_bases=ppd.dictionary.n_bases, regscale=options.regscale)
    if options.databound == "weights":
        return GivenBounds(chi_square_bounds(samples), **common)
    if options.databound == "fixed":
        return GivenBounds(chi_square_bounds(samples, np.broadcast_to(options.l2bound, samples.shape)), **common)
    # from what NNLS leaves, never below the noise that the data show
    floor = ppd.residual_norms / DYNAMIC_RANGE
    if noise is not None:
        floor = np.fmax(floor, np.asarray(noise) * np.sqrt(2.0 * samples))
    return AdaptiveBounds(nnls_norms, **common, floor=floor, rel_change=options.boundrelchange, tol=options.boundtol,
                          step=options.boundstep, min_interval=options.boundinterval)


def _is_noise_only(ppd, bounds):
    """Whether the naturally weighted dirty image holds no peak above 5 times its noise."""
    whitening = np.repeat(bounds.noise_weights.astype(np.float32), np.diff(ppd.offsets))
    dirty = ppd.adjoint(ppd.vis * whitening)
    return bool(np.abs(dirty).max() < NOISE_ONLY_SNR * np.sqrt(bounds.total_weight))


def _mean_brightness(model):
    """Mean brightness of the flux, Σx²/Σ|x|; 1 for an empty image."""
    flux = np.abs(model).sum(dtype=float)
    return float(np.square(model, dtype=float).sum() / flux) if flux > 0 else 1.0
