"""The history of a solution, for the log, the return dictionary and the plots."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

__all__ = ["CONVERGED", "DIVERGED", "EMPTY_MASK", "ITERATION_LIMIT", "NOISE_ONLY", "STOPPED_BY_USER",
           "STOP_DESCRIPTIONS", "STRUCTURED", "SolverRecord", "TIME_LIMIT", "UNFEASIBLE", "UNFINISHED"]

CONVERGED, ITERATION_LIMIT, NOISE_ONLY, STOPPED_BY_USER, DIVERGED, UNFEASIBLE = 101, 102, 103, 104, 105, 106
TIME_LIMIT, STRUCTURED, EMPTY_MASK = 107, 108, 109
STOP_DESCRIPTIONS = {
    CONVERGED: "converged",
    ITERATION_LIMIT: "iteration limit",
    NOISE_ONLY: "noise only",
    STOPPED_BY_USER: "stopped by user",
    DIVERGED: "diverged",
    UNFEASIBLE: "converged, but the data do not fit the bounds",
    TIME_LIMIT: "time limit",
    STRUCTURED: "converged, but the residual is not noise",
    EMPTY_MASK: "the mask is empty",
}
UNFINISHED = (STOPPED_BY_USER, TIME_LIMIT)  # which a restart takes up again


@dataclass
class SolverRecord:
    """History of one solution; every list has one entry per row of `iteration`.

    Attributes
    ----------
    iteration : list of int
    reweighting : list of int
        How many times the weights had been updated.
    rel_change : list of float
        ‖x − x_prev‖/‖x‖ of the iteration.
    residual_norm : list of float
        ‖y − Φx‖ over all blocks, whitened.
    model_flux, model_max : list of float
        Jy and Jy/pixel.
    bounds : list of (int, float (d,))
        Iteration and ε_j, at the start and whenever they moved.
    reweightings : list of dict
        Iteration, scale of the weights, relative change of the model since the one before, pixels that were then
        allowed to be negative, and pixels of the support.
    islands : list of dict
        Of the model, see :func:`casa_sara.solver.islands.islands_of`.
    residual_snr : list of dict
        Largest S/N of the residual, `snr`, smoothed to `beams`.
    gain_errors : dict
        Errors of the antenna gains that the residual showed at the last re-weighting: `interval` within which they
        stay, rms of `amplitude` (relative) and `phase` (rad), `significance` (standard deviations); empty without.
    resumed : list of int
        The iterations of the checkpoints from which the solution was resumed.
    stop_code : int
        One of the codes of this module.
    """

    iteration: list[int] = field(default_factory=list)
    reweighting: list[int] = field(default_factory=list)
    rel_change: list[float] = field(default_factory=list)
    residual_norm: list[float] = field(default_factory=list)
    model_flux: list[float] = field(default_factory=list)
    model_max: list[float] = field(default_factory=list)
    bounds: list[tuple[int, np.ndarray]] = field(default_factory=list)
    reweightings: list[dict] = field(default_factory=list)
    islands: list[dict] = field(default_factory=list)
    residual_snr: list[dict] = field(default_factory=list)
    gain_errors: dict[str, Any] = field(default_factory=dict)
    resumed: list[int] = field(default_factory=list)
    stop_code: int = 0

    @property
    def stop_description(self) -> str:
        """The stop code in words."""
        return STOP_DESCRIPTIONS.get(self.stop_code, "not finished")

    def note(self, ppd: Any, reweighting: int) -> None:
        """Add the state of the iteration `ppd`.

        Parameters
        ----------
        ppd : AdaptivePPD
            After its step.
        reweighting : int
            Number of re-weightings before.
        """
        self.iteration.append(ppd.iteration)
        self.reweighting.append(reweighting)
        self.rel_change.append(ppd.rel_change)
        self.residual_norm.append(float(np.linalg.norm(ppd.residual_norms)))
        self.model_flux.append(ppd.model_flux * ppd.unit_jy)
        self.model_max.append(ppd.model_max * ppd.unit_jy)

    def state(self) -> dict[str, Any]:
        """Return the history so far as plain values."""
        return vars(self) | dict(bounds=[(iteration, bounds.tolist()) for iteration, bounds in self.bounds])

    def set_state(self, state: dict[str, Any]) -> None:
        """Take over what :meth:`state` has returned, and note that the solution was resumed.

        Parameters
        ----------
        state : dict
            As :meth:`state` has returned it.
        """
        for name in vars(self):
            setattr(self, name, state[name])
        self.bounds = [(iteration, np.array(bounds)) for iteration, bounds in self.bounds]
        self.resumed = [*self.resumed, self.iteration[-1]]
