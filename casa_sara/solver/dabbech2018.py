"""Algorithms 1 and 2 of Dabbech et al. 2018 to the letter: hard ℓ2 bounds that adapt, and weights that fall with ω^k.

The task runs them with ``method='dabbech2018'``.  One iteration is that of :mod:`casa_sara.solver.adaptive_ppd` with
ρ = 1 and the prior of :mod:`casa_sara.solver.paperprior`; here are the bounds (Steps 7–10) and Algorithm 2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from casa_sara.options import SolverOptions
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.record import CONVERGED, DIVERGED, ITERATION_LIMIT, STOPPED_BY_USER, SolverRecord

__all__ = ["PaperBounds", "PaperSchedule", "PaperStage", "run_paper_algorithm_2"]

USUAL = 250  # iterations of one weighted problem, for forecasts


@dataclass(frozen=True)
class PaperSchedule:
    """Every parameter of the paper; where the paper gives no number, docs/decisions.md says what was taken and why.

    Attributes
    ----------
    gamma_1 : float
        γ1 (Table A2): σ below which bounds may move.
    gamma_2 : float
        γ2 (Table A2): relative difference of bound and residual norm that is tolerated.
    gamma_3 : float
        γ3 (Table A2): fraction of the way to the residual norm that a bound moves.
    interval : int
        P (Table A2): fewest iterations between two moves of a bound.
    kappa : float
        κ (section 3: "of order 10⁻⁵"), relative to the brightest pixel of the image.
    omega : float
        ω of equation (5); the paper asks for 0 < ω < 1.
    reweightings : int
        Of Algorithm 2, one fewer than the weighted problems, of which section 4.3 has 70 (X band).
    varrho : float
        ϱ (section 2.5): relative change from one problem to the next that ends the re-weighting; 0 for never.
    reltol, final_reltol : float
        σ that ends one weighted problem, and the last (section 4.3).
    nnls_reltol, nnls_iterations : float, int
        Where non-negative least squares (section 3) is taken for solved: relative change, and most iterations.
    niter : int
        Most iterations in all.
    """

    gamma_1: float = 1e-4
    gamma_2: float = 1e-3
    gamma_3: float = 0.618
    interval: int = 100
    kappa: float = 1e-5
    omega: float = 0.8
    reweightings: int = 69
    varrho: float = 0.0
    reltol: float = 1e-5
    final_reltol: float = 1e-6
    nnls_reltol: float = 1e-6
    nnls_iterations: int = 5000
    niter: int = 100_000

    @classmethod
    def of(cls, options: SolverOptions) -> PaperSchedule:
        """The paper's values, but for those that task parameters, set to other than their defaults, give.

        Parameters
        ----------
        options : SolverOptions
            Task parameters: those that are set to other than their defaults count.

        Returns
        -------
        PaperSchedule
        """
        names = dict(boundrelchange="gamma_1", boundtol="gamma_2", boundstep="gamma_3", boundinterval="interval",
                     reweightdecay="omega", nreweights="reweightings", reweighttol="varrho", reltol="reltol",
                     finalreltol="final_reltol", niter="niter")
        usual = SolverOptions()
        given = {ours: getattr(options, name) for name, ours in names.items()
                 if getattr(options, name) != getattr(usual, name)}
        return replace(cls(), **given)

    @property
    def expected_iterations(self) -> int:
        """A guess of how many iterations it takes, for the progress."""
        return min(self.niter, (self.reweightings + 1) * USUAL)

    @property
    def expected_reweightings(self) -> int:
        """A guess of how many re-weightings it takes."""
        return self.reweightings


@dataclass
class PaperBounds:
    """The bounds ε_j of Algorithm 1, and Steps 7–10.

    Parameters
    ----------
    l2_bounds : float (d,)
        ε_j, whitened.
    samples : int (d,)
        M_j.
    weight_sums : float (d,)
        Σ w over the block, in the units of the model.
    adapts : bool
        Whether they move; the paper holds them fixed where the noise is known (section 3).
    """

    l2_bounds: np.ndarray
    samples: np.ndarray
    weight_sums: np.ndarray
    adapts: bool = True
    _sigma: float = field(init=False, default=np.inf)  # σ^(t−1)
    _moved: np.ndarray = field(init=False)  # p_j
    _changing = ("l2_bounds", "_sigma", "_moved")

    def __post_init__(self):
        self.l2_bounds = np.array(self.l2_bounds, float)
        self._moved = np.zeros(len(self.l2_bounds), int)

    @property
    def total_weight(self) -> float:
        """Σ_j σ_j⁻² Σ w for the noise σ_j = ε_j/√(2M_j) of each block."""
        return float(np.sum(self.weight_sums * 2.0 * self.samples / self.l2_bounds**2))

    def adapt(self, ppd: AdaptivePPD, schedule: PaperSchedule) -> bool:
        """Steps 7–10 at the end of iteration t; return whether any bound moved.

        Parameters
        ----------
        ppd : AdaptivePPD
            After its step; takes the bounds.
        schedule : PaperSchedule
            The constants of the method.

        Returns
        -------
        bool
        """
        settled, self._sigma = self._sigma < schedule.gamma_1, ppd.rel_change
        off = np.abs(ppd.residual_norms - self.l2_bounds) > schedule.gamma_2 * self.l2_bounds
        move = off & (ppd.iteration - self._moved >= schedule.interval) & (settled and self.adapts)
        nearer = schedule.gamma_3 * ppd.residual_norms + (1 - schedule.gamma_3) * self.l2_bounds
        self.l2_bounds = np.where(move, nearer, self.l2_bounds)
        self._moved[move] = ppd.iteration
        ppd.constrain(self.l2_bounds)
        return bool(move.any())

    def met_by(self, ppd: AdaptivePPD, schedule: PaperSchedule) -> bool:
        """Whether μ_j ≤ ε_j for all blocks, to within γ2.

        Parameters
        ----------
        ppd : AdaptivePPD
            The iteration, whose residual norms are compared with the bounds.
        schedule : PaperSchedule
            The constants of the method.

        Returns
        -------
        bool
        """
        return bool(np.all(ppd.residual_norms <= (1 + schedule.gamma_2) * self.l2_bounds))

    def state(self) -> dict[str, Any]:
        """Return what has changed since the start."""
        return {name: getattr(self, name) for name in self._changing}

    def set_state(self, state: dict[str, Any]) -> None:
        """Take over what :meth:`state` has returned.

        Parameters
        ----------
        state : dict
            As :meth:`state` has returned it.
        """
        self.l2_bounds, self._moved = np.array(state["l2_bounds"]), np.array(state["_moved"])
        self._sigma = float(state["_sigma"])


@dataclass
class PaperStage:
    """Where Algorithm 2 stands.

    Attributes
    ----------
    previous : real (nx, ny)
        Model of the problem before.
    norm : float
        ‖ΨW‖.
    last : bool
        The present problem is the last.
    record : SolverRecord
    """

    previous: np.ndarray
    norm: float = 1.0
    last: bool = False
    record: SolverRecord = field(default_factory=SolverRecord)

    @property
    def k(self) -> int:
        """Number of re-weightings so far."""
        return len(self.record.reweightings)

    def state(self) -> dict[str, Any]:
        """Return all of it: plain values, and the arrays themselves."""
        return vars(self) | dict(record=self.record.state())

    @classmethod
    def of(cls, state: dict[str, Any]) -> PaperStage:
        """Make it of what :meth:`state` has returned.

        Parameters
        ----------
        state : dict
            As :meth:`state` has returned it.

        Returns
        -------
        PaperStage
        """
        stage = cls(np.array(state["previous"]), state["norm"], state["last"])
        stage.record.set_state(state["record"])
        return stage


def run_paper_algorithm_2(ppd: AdaptivePPD, bounds: PaperBounds, schedule: PaperSchedule = PaperSchedule(),
          progress: Callable[[AdaptivePPD, SolverRecord], None] = lambda ppd, record: None,
          stopped: Callable[[], bool] = lambda: False,
          keep: Callable[[PaperStage, bool], None] = lambda stage, now: None,
          stage: PaperStage | None = None) -> SolverRecord:
    """Algorithm 2: solve, re-weight, and solve again, each time from the primal and dual variables there are.

    Parameters
    ----------
    ppd : AdaptivePPD
        With ρ = 1, a `PaperPrior` for dictionary, and κ set (`threshold`).
    bounds : PaperBounds
        Bounds of the blocks, which are changed.
    schedule : PaperSchedule
        The constants of the method.
    progress, stopped, keep, stage
        As of :func:`casa_sara.solver.reweighting.run_algorithm_2`.

    Returns
    -------
    SolverRecord
    """
    if stage is None:
        stage = PaperStage(ppd.model.copy())
        stage.record.bounds.append((0, bounds.l2_bounds.copy()))
    ppd.constrain(bounds.l2_bounds)
    ppd.dictionary.norm, record = stage.norm, stage.record
    while True:
        stage.last = stage.last or stage.k >= schedule.reweightings
        record.stop_code = _run_algorithm_1(ppd, bounds, schedule, stage, progress, stopped, keep)
        if stage.last or record.stop_code != CONVERGED:
            break
        _renew_weights(ppd, schedule, stage)
    if record.stop_code == DIVERGED:
        ppd.model[...] = stage.previous
    return record


def _run_algorithm_1(ppd, bounds, schedule, stage, progress, stopped, keep):
    """Algorithm 1 for one set of weights; return its stop code."""
    tolerance, record = schedule.final_reltol if stage.last else schedule.reltol, stage.record
    while True:
        ppd.step()  # Steps 5–6 and 11–19
        record.note(ppd, stage.k)
        moved = bounds.adapt(ppd, schedule)  # Steps 7–10
        if moved:
            record.bounds.append((ppd.iteration, bounds.l2_bounds.copy()))
        progress(ppd, record)
        if not np.isfinite(ppd.rel_change) or not np.isfinite(record.residual_norm[-1]):
            return DIVERGED
        if ppd.iteration >= schedule.niter:
            return ITERATION_LIMIT
        if ppd.rel_change < tolerance and not moved and bounds.met_by(ppd, schedule):
            return CONVERGED
        ending = stopped()
        keep(stage, ending)
        if ending:
            return STOPPED_BY_USER


def _renew_weights(ppd, schedule, stage):
    """Step 3 of Algorithm 2; within ϱ the weights stay, and one last problem follows."""
    norm = float(np.linalg.norm(ppd.model))
    change = float(np.linalg.norm(ppd.model - stage.previous)) / norm if norm > 0 else 0.0
    stage.previous[...] = ppd.model
    stage.last = change < schedule.varrho
    if stage.last:
        return
    scale = schedule.omega ** (stage.k + 1)
    ppd.dictionary.reweight(ppd.model, scale, ppd.l1_weights)
    stage.norm = ppd.dictionary.norm
    stage.record.reweightings.append(dict(iteration=ppd.iteration, scale=scale, model_change=change, released=0))
