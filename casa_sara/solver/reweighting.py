"""Algorithm 2 of Dabbech et al. 2018: re-weighted ℓ1 problems, solved one after the other."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l1_weights import first_weights, reweight
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds
from casa_sara.solver.positivity import Release
from casa_sara.solver.record import (
    CONVERGED,
    DIVERGED,
    ITERATION_LIMIT,
    STOPPED_BY_USER,
    STRUCTURED,
    UNFEASIBLE,
    SolverRecord,
)
from casa_sara.solver.residual_structure import STRUCTURE, look_at, structure_of
from casa_sara.solver.significance import SignificantSupport

__all__ = ["Schedule", "Stage", "Steps", "algorithm_2", "run_algorithm_2", "stepped"]

# asks for one step of the iteration that it yields, whose gradients are weighed by the bounds; returns its result
Steps = Generator[tuple[AdaptivePPD, GivenBounds | AdaptiveBounds], None, Any]

RISE = 1.05  # of the residual norm within one interval, from its least
STEADY = 3e-3  # relative change of the residual norm within one interval
FIRST_SCALE, LAST_SCALE = 10.0, 1.5  # α, in units of the noise of each band
RELEASE_SCALE = 4.0  # α from which on the residual shows what positive pixels cannot hold, and errors of gains
FIRST_INTERVALS = 2  # of the first problem, whose model starts from nothing
NEARLY = 2.0  # bounds may be off by so many of their tolerances where the model changes by one of its own over this
LONGEST = 50  # intervals of the last problem: what still moves then is below what the data can tell
USUAL = 9  # re-weightings that most data need
OF_COSTLY = (0, 1, 2, 4, 8, 16)  # re-weightings at which averages of visibilities on the disk are made anew
CHANGING = 0.03  # of the structure that the residual holds, in an interval: then the last problem goes on
PATIENCE = 300  # iterations that a settled model is given to meet its bounds


@dataclass(frozen=True)
class Schedule:
    """When to re-weight and when to stop.

    Attributes
    ----------
    niter : int
        Most iterations in all.
    nreweights : int
        Most re-weightings.
    reweight_decay : float
        ω, factor on the scale of the weights.
    reweight_tol : float
        ϱ: two re-weighted solutions that differ by less end the re-weighting, once the bounds are met.
    reltol, final_reltol : float
        Relative change that ends one ℓ1 problem, and the last one.
    interval : int
        Most iterations of one ℓ1 problem before the last.
    significance : float
        Standard deviations that emission needs to be in the model; 0 for a model that nothing confines. It is looked
        for at every re-weighting, so there is no support without one.
    """

    niter: int = 100_000
    nreweights: int = 20
    reweight_decay: float = 0.618
    reweight_tol: float = 1e-2
    reltol: float = 3e-4
    final_reltol: float = 3e-4
    interval: int = 30
    significance: float = 0.0

    @property
    def confined(self) -> bool:
        """Whether the model is confined to what is significant."""
        return self.significance > 0 and self.nreweights > 0

    @property
    def expected_iterations(self) -> int:
        """A guess of how many iterations it takes, for the progress."""
        return min(self.niter, (self.expected_reweightings + 3) * self.interval)

    @property
    def expected_reweightings(self) -> int:
        """A guess of how many re-weightings it takes."""
        return min(self.nreweights, USUAL)


@dataclass
class Stage:
    """The state of Algorithm 2, in addition to those of the iteration and its bounds.

    Attributes
    ----------
    previous : real (nx, ny)
        Model for which averaged samples are exact, that of the problem before.
    last : bool
        The weights will not change any more.
    start : int
        Iteration after which the present problem began.
    settled : int
        For how many iterations the model has changed by less than the tolerance.
    structure : float
        Largest S/N of the residual over a beam or more, when the last problem had converged.
    until : int
        Iteration to which the last problem goes on, because that still changes.
    release : Release
    support : SignificantSupport or None
    record : SolverRecord
    """

    previous: np.ndarray
    last: bool = False
    start: int = 0
    settled: int = 0
    structure: float = float("inf")
    until: int = 0
    release: Release = field(default_factory=Release)
    support: SignificantSupport | None = None
    record: SolverRecord = field(default_factory=SolverRecord)

    @property
    def k(self) -> int:
        """Number of the problem, which is that of the re-weightings before it."""
        return len(self.record.reweightings)

    def state(self) -> dict[str, Any]:
        """Return all of it: plain values, and the arrays themselves."""
        return vars(self) | dict(release=self.release.state(), record=self.record.state(),
                                 support=self.support and self.support.state())

    @classmethod
    def of(cls, state: dict[str, Any]) -> Stage:
        """Make it of what :meth:`state` has returned.

        Parameters
        ----------
        state : dict
            As :meth:`state` has returned it.

        Returns
        -------
        Stage
        """
        names = ("last", "start", "settled", "structure", "until")
        stage = cls(np.array(state["previous"]), **{name: state[name] for name in names})
        stage.release.set_state(state["release"])
        stage.support = state["support"] and SignificantSupport(**state["support"])
        stage.record.set_state(state["record"])
        return stage


def run_algorithm_2(ppd: AdaptivePPD, bounds: GivenBounds | AdaptiveBounds, schedule: Schedule = Schedule(),
          progress: Callable[[AdaptivePPD, SolverRecord], None] = lambda ppd, record: None,
          stopped: Callable[[], bool] = lambda: False, keep: Callable[[Stage, bool], None] = lambda stage, now: None,
          stage: Stage | None = None) -> SolverRecord:
    """Do all of :func:`algorithm_2`, whose arguments these are.

    Parameters
    ----------
    ppd, bounds, schedule, progress, stopped, keep, stage
        As of :func:`algorithm_2`.

    Returns
    -------
    SolverRecord
    """
    record: SolverRecord = stepped(algorithm_2(ppd, bounds, schedule, progress, stopped, keep, stage))
    return record


def stepped(steps: Steps) -> Any:
    """Take the steps that are asked for, and return the result.

    Parameters
    ----------
    steps : generator
        As :func:`algorithm_2`.

    Returns
    -------
    object
        What the generator returns.
    """
    while True:
        try:
            ppd, _ = next(steps)
        except StopIteration as end:
            return end.value
        ppd.step()


def algorithm_2(ppd: AdaptivePPD, bounds: GivenBounds | AdaptiveBounds, schedule: Schedule = Schedule(),
                progress: Callable[[AdaptivePPD, SolverRecord], None] = lambda ppd, record: None,
                stopped: Callable[[], bool] = lambda: False,
                keep: Callable[[Stage, bool], None] = lambda stage, now: None, stage: Stage | None = None) -> Steps:
    """Algorithm 2: solve, re-weight, and solve again until nothing changes.

    The weights start at W = ν, the noise of each band relative to that of a pixel (at least 1); those of re-weighting k
    are W = ν α/(α + d̄) with d̄ the root mean square of a coefficient of Ψ†x and its eight neighbours, and
    α = max(10 ω^{k−1}, 1.5) × the noise of the band or of a pixel, whichever is less.  The paper has 1, ω^k × the
    largest coefficient of the basis, and d̄ = |Ψ†x|: docs/decisions.md, "Weights from the noise".

    Parameters
    ----------
    ppd : AdaptivePPD
        The iteration, with its first κ (`threshold`) set.
    bounds : GivenBounds or AdaptiveBounds
        Bounds of the blocks, which are changed where they adapt.
    schedule : Schedule
        Tolerances and numbers of iterations and of re-weightings.
    progress : callable
        Called after every iteration with (ppd, record).
    stopped : callable
        Asked after every iteration; True ends the solution with what there is.
    keep : callable
        Called between iterations with the stage, and whether the solution was stopped: from the states of `ppd`,
        `bounds` and the stage at such a moment another call goes on as this one would have.
    stage : Stage, optional
        Where to go on from, with `ppd` and `bounds` in the states that belong to it.

    Yields
    ------
    ppd, bounds
        Whenever the iteration is to do its next step: between two of these its state is that of whole iterations.

    Returns
    -------
    SolverRecord
    """
    stage = _begin(ppd, bounds, schedule) if stage is None else stage
    record = stage.record
    while True:
        if stage.k >= schedule.nreweights and not stage.last:
            _begin_last(ppd, bounds, stage)
        record.stop_code = yield from _run_algorithm_1(ppd, bounds, schedule, stage, progress, stopped, keep)
        if record.stop_code != CONVERGED or not _begin_next(ppd, bounds, schedule, stage):
            break
    if record.stop_code == DIVERGED:
        ppd.model[...] = stage.previous
    elif schedule.confined and look_at(ppd, bounds, record) and record.stop_code == CONVERGED:
        record.stop_code = STRUCTURED
    return record


def _begin(ppd, bounds, schedule):
    """The first problem."""
    bounds.apply_to(ppd)
    ppd.renew_averages(ppd.model)
    first_weights(ppd, bounds, schedule.confined)
    stage = Stage(ppd.model.copy(), support=SignificantSupport(schedule.significance) if schedule.confined else None)
    stage.record.bounds.append((0, bounds.l2_bounds.copy()))
    return stage


def _begin_next(ppd, bounds, schedule, stage):
    """The next problem, or the last one anew; return False where nothing would change."""
    if stage.last:
        return schedule.confined and _structure_changes(ppd, bounds, schedule, stage)
    if _renew_weights(ppd, bounds, schedule, stage):
        stage.start, stage.settled = ppd.iteration, 0
    else:
        _begin_last(ppd, bounds, stage)
    return True


def _begin_last(ppd, bounds, stage):
    """The last problem, with the weights as they are."""
    if ppd.averaged is not None and ppd.averaged.costly:
        stage.previous[...] = ppd.model
        ppd.renew_averages(stage.previous)
    bounds.finish(ppd)
    stage.last, stage.start, stage.settled = True, ppd.iteration, 0


def _structure_changes(ppd, bounds, schedule, stage):
    """Whether the residual still holds structure, and it changes: then the last problem goes on for an interval."""
    if ppd.iteration - stage.start >= LONGEST * schedule.interval:
        return False
    before, stage.structure = stage.structure, structure_of(ppd, bounds)
    if stage.structure <= STRUCTURE or abs(stage.structure / before - 1) <= CHANGING:
        return False
    stage.until, stage.settled = ppd.iteration + schedule.interval, 0
    return True


def _run_algorithm_1(ppd, bounds, schedule, stage, progress, stopped, keep):
    """Algorithm 1 for one set of weights; return its stop code."""
    record = stage.record
    while True:
        yield ppd, bounds  # Steps 5–6 and 11–19
        record.note(ppd, stage.k)
        if bounds.adapt(ppd):  # Steps 7–10
            record.bounds.append((ppd.iteration, bounds.l2_bounds.copy()))
        progress(ppd, record)
        code = _stop_code(ppd, bounds, schedule, stage)
        if code is not None:
            return code
        ending = stopped()
        keep(stage, ending)
        if ending:
            return STOPPED_BY_USER


def _stop_code(ppd, bounds, schedule, stage):
    """Return why Algorithm 1 ends after this iteration, None where it goes on; κ is adjusted after an interval."""
    norms, done = stage.record.residual_norm, ppd.iteration - stage.start
    if not np.isfinite(ppd.rel_change) or not np.isfinite(norms[-1]):
        return DIVERGED
    if ppd.iteration >= schedule.niter:
        return ITERATION_LIMIT
    if done % schedule.interval == 0:
        _damp(ppd, norms[-schedule.interval:])
    if not stage.last and done >= (FIRST_INTERVALS if stage.k == 0 else 1) * schedule.interval:
        return CONVERGED
    if ppd.iteration < stage.until:
        return None
    # the model has settled; the residual and the bounds may need longer, but not for ever
    tolerance = schedule.final_reltol if stage.last else schedule.reltol
    stage.settled = stage.settled + 1 if ppd.rel_change < tolerance else 0
    steady = not stage.last or _is_steady(norms[stage.start:], schedule.interval)
    if done > 1 and stage.settled and steady and bounds.met_by(ppd):
        return CONVERGED
    if stage.settled >= PATIENCE or done >= LONGEST * schedule.interval:
        return CONVERGED if bounds.met_by(ppd) else UNFEASIBLE
    return None


def _renew_weights(ppd, bounds, schedule, stage):
    """Re-weight by the present solution; return False, with nothing done, when one more would change nothing."""
    change = ppd.comm.bcast_numbers([_change(ppd.planes, ppd.model, stage.previous)])[0]
    stage.previous[...] = ppd.model
    if stage.k in OF_COSTLY or ppd.averaged is None or not ppd.averaged.costly:
        ppd.renew_averages(stage.previous)
    scale = FIRST_SCALE * schedule.reweight_decay**stage.k
    released = stage.release.update(ppd, bounds) if scale <= RELEASE_SCALE else 0
    if scale <= LAST_SCALE and not released and _is_settled(ppd, bounds, schedule, change):
        return False
    support = stage.support
    calibration = ppd.calibration if scale <= RELEASE_SCALE else None
    pixels = support.update(ppd, bounds, calibration) if support else ppd.model.size
    if calibration is not None:
        stage.record.gain_errors = calibration.summary
    reweight(ppd, bounds, max(scale, LAST_SCALE), support is not None)
    stage.record.reweightings.append(dict(iteration=ppd.iteration, scale=max(scale, LAST_SCALE), model_change=change,
                                          released=released, support=pixels))
    return True


def _is_settled(ppd, bounds, schedule, change):
    """Whether one more re-weighting would change nothing that the data can tell."""
    slack = NEARLY if change < schedule.reweight_tol / NEARLY else 1.0
    return change < schedule.reweight_tol and bounds.met_by(ppd, slack)


def _damp(ppd, residual_norms):
    """Halve κ where the residual rises again: the prior moves the image further than the data can follow.

    κ is how far one iteration can move what only the prior knows of; the larger it is, the harder, and the less
    damped, are the constraints of the data.
    """
    if residual_norms[-1] > RISE * min(residual_norms):
        ppd.rescale(0.5 * ppd.threshold)


def _is_steady(residual_norms, interval):
    """Whether the residual has changed by less than `STEADY` within the last interval."""
    recent = residual_norms[-interval:]
    return len(recent) == interval and max(recent) - min(recent) < STEADY * recent[-1]


def _change(planes, model, previous):
    """Return the relative change of the model: of all of it, or of the main image, whichever is larger."""
    change = _relative(model, previous)
    return change if len(planes.parts) == 1 else max(change, _relative(planes.main(model), planes.main(previous)))


def _relative(model, previous):
    norm = np.linalg.norm(model)
    return float(np.linalg.norm(model - previous) / norm) if norm > 0 else 0.0
