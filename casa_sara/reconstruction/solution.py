"""The iteration of a problem with its bounds: begun from the first image, or gone on with from a checkpoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from casa_sara.data.distribution import Layout
from casa_sara.options import SolverOptions
from casa_sara.parallel.partition import RankAssignment
from casa_sara.reconstruction.bootstrap import Bootstrap, Jackknife, jackknife_groups
from casa_sara.reconstruction.checkpoint import Checkpoint
from casa_sara.reconstruction.draws import Draws
from casa_sara.reconstruction.paper_method import PAPER, block_norms, first_threshold, paper_iteration
from casa_sara.reconstruction.problem import Findings, Problem, Samples, first_image
from casa_sara.reconstruction.result import Reconstruction
from casa_sara.reconstruction.settings import bounds_of
from casa_sara.reconstruction.total_power import MOST, WhitenedDish
from casa_sara.solver.adaptive_ppd import BASIS_ARRAYS, SAMPLE_ARRAYS, AdaptivePPD
from casa_sara.solver.dabbech2018 import PaperBounds, PaperStage
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds
from casa_sara.solver.planes import Images, Planes
from casa_sara.solver.record import DIVERGED, UNFINISHED, SolverRecord
from casa_sara.solver.reweighting import Stage
from casa_sara.solver.significance import SignificantSupport

__all__ = ["Solution", "begin", "begin_draws", "resume"]

STEP_BALANCE = 0.15  # κ in units of the mean brightness Σx²/Σ|x| of the first model
NOISE_ONLY_SNR = 5.0


@dataclass
class Solution:
    """The iteration of a problem with its bounds, begun or gone on with."""

    found: Findings
    ppd: AdaptivePPD
    bounds: AdaptiveBounds | GivenBounds | PaperBounds
    stage: Stage | PaperStage | None = None
    result: Reconstruction | None = None
    resamplings: dict[str, Bootstrap] = field(default_factory=dict)
    dish: WhitenedDish | None = None
    subbands: Any = None

    @classmethod
    def of(cls, problem: Problem, found: Findings, options: SolverOptions, ranks: RankAssignment) -> Solution:
        """Put it together, at the very beginning.

        Parameters
        ----------
        problem : Problem
            Whitened samples, or averages of them, and the operators that belong to them.
        found : Findings
            What is known before the first iteration.
        options : SolverOptions
            Task parameters of the method.
        ranks : RankAssignment
            The ranks that share the work.

        Returns
        -------
        Solution
        """
        measurement, samples = problem.measurement, problem.samples
        subbands, planes = problem.subbands, _planes(problem, options.positivity)
        dictionary = problem.dictionary(ranks.wavelets(options.wavelets), options)
        if options.method == PAPER:
            ppd = paper_iteration(problem, dictionary, found.data_norm_sq, options.positivity)
        else:
            ppd = AdaptivePPD(measurement, dictionary, problem.vis, problem.offsets, problem.precond,
                              found.data_norm_sq, options.positivity, comm=ranks.comm)
        ppd.unit_jy, ppd.averaged, ppd.sky_over_image = problem.unit_jy, problem.renewing, problem.sky_over_image
        ppd.planes = planes
        ppd.samples = ranks.comm.exscan(problem.block_sizes)[1]
        if problem.support is not None:
            ppd.confine(problem.support)
        weights = samples.data.weight * np.float32(problem.unit_jy**2)
        weight_sums, noise, dish = ranks.comm.block_sums(weights, samples.offsets), samples.noise, problem.dish
        most: float | np.ndarray = np.inf
        if dish is not None:
            most = np.append(np.full(weight_sums.size, np.inf), MOST)
            weight_sums = np.append(weight_sums, dish.weight_sum)
            noise = None if noise is None else np.append(noise, np.nan)
        bounds = bounds_of(ppd, found.nnls_norms, weight_sums, noise, options, most)
        return cls(found, ppd, bounds, dish=dish, subbands=subbands)

    def state(self, stage: Stage | PaperStage | None, layout: Layout, ranks: RankAssignment) -> dict[str, Any]:
        """Return, on rank 0, all that :func:`resume` needs beside data and parameters, as one rank alone has it.

        Parameters
        ----------
        stage : Stage, PaperStage or None
            Where Algorithm 2 is; None once it has come to its end.
        layout : Layout
            Of the samples given.
        ranks : RankAssignment
            The ranks that share the work.

        Returns
        -------
        dict
        """
        left_out = np.concatenate(ranks.comm.allgather(layout.numbers(self.found.left_out)))
        found = vars(self.found) | dict(left_out=np.sort(left_out))
        ppd, kept = self.ppd.state(), Layout(self.ppd.offsets, ranks.comm)
        ppd |= {name: kept.gather(ppd[name]) for name in SAMPLE_ARRAYS}
        ppd |= {name: ranks.gather_bases(ppd[name]) for name in BASIS_ARRAYS}
        state = dict(found=found, ppd=ppd, bounds=self.bounds.state())
        if self.result is None:
            assert stage is not None
            return state | dict(stage=stage.state())
        result = vars(self.result) | dict(record=self.result.record.state(), kept=None, draws=None, jackknife=None)
        return state | dict(result=result, resamplings={name: one.state() for name, one in self.resamplings.items()})


def begin_draws(solution: Solution, record: SolverRecord, options: SolverOptions) -> None:
    """Make ready for the draws, once the solution has come to an end; an empty model has no errors to draw.

    Parameters
    ----------
    solution : Solution
        Whose `resamplings` are made.
    record : SolverRecord
        How it has ended.
    options : SolverOptions
        `ndraws` and `jackknife` are asked for there.
    """
    ppd, bounds = solution.ppd, solution.bounds
    if record.stop_code in (*UNFINISHED, DIVERGED) or not (options.ndraws or options.jackknife):
        return
    assert not isinstance(bounds, PaperBounds)  # reconstruct refuses draws with the paper's method
    model, scale = ppd.model.copy(), record.reweightings[-1]["scale"] if record.reweightings else 0.0
    groups = jackknife_groups(len(bounds.l2_bounds)) if options.jackknife else 0
    for name, kind, asked in ("jackknife", Jackknife, groups), ("draws", Bootstrap, options.ndraws):
        if asked:
            draws = Draws(model.shape, asked if model.any() else 0)
            solution.resamplings[name] = kind(ppd, bounds, _support(options), scale, model, ppd.threshold, draws)


def _support(options):
    """Return the support of a solution that has found one, None where nothing confines the model."""
    confined = options.significance > 0 and options.nreweights > 0
    return SignificantSupport(options.significance, begun=True) if confined else None


def begin(samples: Samples, problem_of: Callable[..., Problem], options: SolverOptions,
          startmodel: np.ndarray | None, stopped: Callable[[], bool], ranks: RankAssignment) -> Solution:
    """Leave out wild samples, and begin from the first image or from `startmodel`.

    Parameters
    ----------
    samples : Samples
        All that were given.
    problem_of : callable
        Makes the `Problem` of samples.
    options : SolverOptions
        Task parameters of the method.
    startmodel : real (nx, ny) or None
        Jy/pixel.
    stopped : callable
        Ends the fit of the first image early when it returns True.
    ranks : RankAssignment
        The ranks that share the work.

    Returns
    -------
    Solution
    """
    problem, found, first = first_image(samples, problem_of, options, stopped, ranks.comm)
    if startmodel is not None:
        startmodel = _planes(problem).stacked(startmodel / np.float32(problem.unit_jy))
        if problem.support is not None:
            startmodel *= problem.support
    if options.method == PAPER:
        found.nnls_norms = block_norms(problem, problem_of, options, stopped)
        solution = Solution.of(problem, found, options, ranks)
        model = np.zeros_like(first) if startmodel is None else startmodel
        threshold = first_threshold(options, first)
    else:
        solution = Solution.of(problem, found, options, ranks)
        found.noise_only = _is_noise_only(solution.ppd, solution.bounds)
        model = first if startmodel is None else startmodel
        main = solution.ppd.planes.main(model)
        threshold = STEP_BALANCE * _mean_brightness(main if main.any() else model)
    solution.ppd.start_from(model)
    solution.ppd.rescale(threshold)
    return solution


def resume(samples: Samples, layout: Layout, problem_of: Callable[..., Problem], options: SolverOptions,
           checkpoint: Checkpoint, ranks: RankAssignment) -> Solution:
    """Go on from the state that rank 0 has read.

    Parameters
    ----------
    samples : Samples
        All that were given.
    layout : Layout
        Of these samples.
    problem_of : callable
        Makes the `Problem` of samples.
    options : SolverOptions
        Task parameters of the method.
    checkpoint : Checkpoint
        With the state.
    ranks : RankAssignment
        The ranks that share the work.

    Returns
    -------
    Solution

    Raises
    ------
    CheckpointError
        The state is not one of these data.
    """
    with checkpoint.applied(ranks.comm.rank == 0) as state:
        state = _plain_state(state, ranks.comm)
        values: dict[str, Any] = {name: np.array(value) if isinstance(value, np.ndarray) else value
                                  for name, value in state["found"].items()}
        found = Findings(**values)
        found.left_out = layout.here(found.left_out)
        problem = problem_of(samples.without(found.left_out), data_norm_sq=found.data_norm_sq, finer=found.finer)
        solution = Solution.of(problem, found, options, ranks)
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
            solution.ppd.set_state(ppd)  # the correction is of the multipliers then
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


def _plain_state(state, comm):
    """Return the state with all that every rank needs whole; what is spread over them stays on rank 0."""
    if comm.size == 1:
        return state
    spread = {name: state["ppd"].pop(name) for name in (*SAMPLE_ARRAYS, *BASIS_ARRAYS)} if comm.rank == 0 else {}
    state = comm.bcast(state)
    return state | dict(ppd=state["ppd"] | {name: spread.get(name) for name in (*SAMPLE_ARRAYS, *BASIS_ARRAYS)})


def _planes(problem, positivity=True):
    """Return the planes of the unknown."""
    subbands = problem.subbands
    if subbands is None:
        return Planes() if len(problem.shapes) == 1 else Images(problem.shapes)
    return Planes(np.sqrt(subbands.shares), subbands.reference_weights(), positivity)


def _is_noise_only(ppd, bounds):
    """Whether the naturally weighted dirty image holds no peak above 5 times its noise."""
    whitening = np.repeat(bounds.noise_weights.astype(np.float32), np.diff(ppd.offsets))
    dirty = ppd.adjoint(ppd.vis * whitening)
    return bool(np.abs(dirty).max() < NOISE_ONLY_SNR * np.sqrt(bounds.total_weight))


def _mean_brightness(model):
    """Mean brightness of the flux, Σx²/Σ|x|; 1 for an empty image."""
    flux = np.abs(model).sum(dtype=float)
    return float(np.square(model, dtype=float).sum() / flux) if flux > 0 else 1.0
