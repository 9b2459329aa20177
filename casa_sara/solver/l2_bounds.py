"""The ℓ2 bounds of the data blocks: given, or adapted while the image is made."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from casa_sara.solver.adaptive_ppd import AdaptivePPD

__all__ = ["AdaptiveBounds", "GivenBounds", "chi_square_bounds"]

PATIENCE = 5  # times as long before a bound moves of a block that others cannot correct


def chi_square_bounds(samples: np.ndarray, noise: npt.ArrayLike = 1.0) -> np.ndarray:
    """Bounds ε_j that hold the noise of each block with a margin of two standard deviations.

    A whitened complex sample has unit variance in its real and in its imaginary part when WEIGHT = 1/σ², so
    ‖n_j‖² is χ² with 2M_j degrees of freedom: ε_j² = noise_j²·(2M_j + 2√(4M_j)).

    Parameters
    ----------
    samples : int (d,)
        M_j, complex samples of each block.
    noise : float or float (d,)
        Standard deviation of the whitened real parts: 1 when the weights are right.

    Returns
    -------
    float64 (d,)
    """
    degrees = 2.0 * np.asarray(samples, float)
    return np.asarray(noise) * np.sqrt(degrees + 2 * np.sqrt(2 * degrees))


@dataclass
class _NoiseLevels:
    """What given and adaptive bounds share: noise levels, and the multipliers that belong to them.

    A bound is a noise level, ε_j = σ_j √(2M_j), σ_j relative to the MS weights, thermal noise and
    calibration errors together.  The level fixes the Lagrange multiplier of the block's ellipsoid: the image
    that minimises

        κ_g ‖WΨ†x‖₁ + ½ Σ_j ‖y_j − Φ_j x‖²/σ_j²,     κ_g = regscale · √(Σ_j σ_j⁻² Σ_{m∈j} w_m) / √b,

    is regularised at the noise: κ_g is the noise of one Dirac coefficient of the gradient Φ†n (w the whitening
    weights, b bases), times regscale.  In Algorithm 1, whose κ is free, that is λ_j = κ/(η κ_g σ_j²).
    A radius would have to be right to a fraction 1/√(2M_j) to mean anything; a multiplier need not.

    Parameters
    ----------
    l2_bounds : float (d,)
        ε_j, whitened.
    samples : int (d,)
        M_j.
    weight_sums : float (d,)
        Σ w over the block, in the units of the model.
    n_bases : int
    regscale : float
    """

    l2_bounds: np.ndarray
    samples: np.ndarray
    weight_sums: np.ndarray
    n_bases: int
    regscale: float = 1.0
    _changing: ClassVar[tuple[str, ...]] = ("l2_bounds",)

    @property
    def noise(self) -> np.ndarray:
        """σ_j: noise level relative to the MS weights, (d,)."""
        return self.l2_bounds / np.sqrt(2.0 * self.samples)

    @property
    def noise_weights(self) -> np.ndarray:
        """1/σ_j², (d,)."""
        return self.noise**-2.0

    @property
    def total_weight(self) -> float:
        """Σ_j σ_j⁻² Σ w: the peak of the point spread function of the weighted data."""
        return float(np.sum(self.weight_sums * self.noise_weights))

    @property
    def gradient_noise(self) -> float:
        """κ_g."""
        return self.regscale * np.sqrt(self.total_weight / self.n_bases)

    def apply_to(self, ppd: AdaptivePPD) -> None:
        """Hand the multipliers to the iteration, for its current κ."""
        ppd.penalise(ppd.threshold / (ppd.l2_step * self.gradient_noise) * self.noise_weights)

    def state(self) -> dict[str, Any]:
        """Return what has changed since the start."""
        return {name: getattr(self, name) for name in self._changing}

    def set_state(self, state: dict[str, Any]) -> None:
        """Take over what :meth:`state` has returned."""
        for name in self._changing:
            value = state[name]
            setattr(self, name, np.array(value) if isinstance(value, np.ndarray) else value)


@dataclass
class GivenBounds(_NoiseLevels):
    """Bounds that stay as they are, and are hard constraints ‖y_j − Φ_j x‖ ≤ ε_j of the last problem."""

    def finish(self, ppd: AdaptivePPD) -> None:
        """Make the bounds hard constraints, from where the multipliers have led.

        Parameters
        ----------
        ppd : AdaptivePPD
            The iteration, which is told its bounds.
        """
        ppd.constrain(self.l2_bounds)

    def adapt(self, ppd: AdaptivePPD) -> bool:
        """Nothing adapts; return False.

        Parameters
        ----------
        ppd : AdaptivePPD
            The iteration; it is not looked at.

        Returns
        -------
        bool
        """
        return False

    def met_by(self, ppd: AdaptivePPD, slack: float = 1.0) -> bool:
        """Whether every block's residual is inside its bound, but for a relative 1e-3 × slack.

        Parameters
        ----------
        ppd : AdaptivePPD
            The iteration, whose residual norms are compared with the bounds.
        slack : float
            Factor on the tolerance.

        Returns
        -------
        bool
        """
        return not ppd.constrained or bool(np.all(ppd.residual_norms <= self.l2_bounds * (1 + 1e-3 * slack)))


@dataclass
class AdaptiveBounds(_NoiseLevels):
    """Bounds that follow the residual of each block (Algorithm 1, Steps 6–10).

    A bound moves as in the paper: when the model has settled (σ < γ1), at least P iterations after its last
    move, and when the residual differs by more than γ2, by the fraction γ3 of the way to the residual norm μ_j.
    It never falls below `floor`, nor to where a block would count for more than `most` allows.

    Parameters
    ----------
    floor : float (d,)
        Lowest bounds allowed.
    most : float (d,)
        Largest weight of each block, σ_j⁻² Σ w, relative to that of all others.
    rel_change, tol, step, min_interval
        γ1, γ2, γ3, P.
    """

    floor: np.ndarray | float = 0.0
    most: np.ndarray | float = np.inf
    rel_change: float = 1e-2
    tol: float = 1e-2
    step: float = 0.618
    min_interval: int = 20
    _last_move: np.ndarray = field(init=False)
    _changing = ("l2_bounds", "_last_move")

    def __post_init__(self):
        self.l2_bounds = np.maximum(self.l2_bounds, self.floor)
        self.l2_bounds = np.maximum(self.l2_bounds, self._lowest())
        self._last_move = np.zeros(len(self.l2_bounds), int)

    def finish(self, ppd: AdaptivePPD) -> None:
        """Nothing changes for the last problem.

        Parameters
        ----------
        ppd : AdaptivePPD
            The iteration; it is not changed.
        """

    def adapt(self, ppd: AdaptivePPD) -> bool:
        """Steps 7–10; return whether any bound moved.

        Parameters
        ----------
        ppd : AdaptivePPD
            After its step; takes the multipliers of the new bounds.

        Returns
        -------
        bool
        """
        if ppd.rel_change >= self.rel_change:
            return False
        interval = np.where(np.isfinite(self.most), PATIENCE, 1) * self.min_interval
        move = (ppd.iteration - self._last_move >= interval) & self._off_target(ppd)
        if not move.any():
            return False
        target = np.maximum(ppd.residual_norms, self._lowest())
        self.l2_bounds = np.where(move, self.step * target + (1 - self.step) * self.l2_bounds, self.l2_bounds)
        self._last_move[move] = ppd.iteration
        self.apply_to(ppd)
        return True

    def met_by(self, ppd: AdaptivePPD, slack: float = 1.0) -> bool:
        """Whether every block's residual agrees with its bound, to slack × γ2.

        Parameters
        ----------
        ppd : AdaptivePPD
            The iteration, whose residual norms are compared with the bounds.
        slack : float
            Factor on the tolerance γ2.

        Returns
        -------
        bool
        """
        return not np.any(self._off_target(ppd, slack))

    def _off_target(self, ppd, slack=1.0):
        """Condition (iii): blocks whose residual norm, or floor, is further than slack × γ2 from the bound."""
        target = np.maximum(ppd.residual_norms, self._lowest())
        # what few samples know of their own noise is 1/√(4M)
        tol = np.where(np.isfinite(self.most), np.maximum(self.tol, 0.5 / np.sqrt(self.samples)), self.tol)
        return np.abs(target - self.l2_bounds) > slack * tol * self.l2_bounds

    def _lowest(self):
        """The lowest bounds at the present noise of the other blocks."""
        if not np.isfinite(self.most).any():
            return self.floor
        weights = self.weight_sums * self.noise_weights
        others = weights.sum() - weights
        return np.maximum(self.floor, np.sqrt(2.0 * self.samples * self.weight_sums / (self.most * others)))

    def apply_to(self, ppd: AdaptivePPD) -> None:
        """Hand the multipliers to the iteration, those of limited blocks for a prior as strong as their own noise.

        Parameters
        ----------
        ppd : AdaptivePPD
            Takes the multipliers, for its current κ.
        """
        super().apply_to(ppd)
        if np.isfinite(self.most).any():
            weights = self.weight_sums * self.noise_weights
            own = np.sqrt((weights.sum() - weights) / weights)
            ppd.penalise(ppd.multipliers * np.where(np.isfinite(self.most), own, 1.0))
