"""Iterations of Q, U and V that are done side by side, with |(Q, U, V)| ≤ I in every pixel.

I is known.  Each of the others, s, has an iteration of its own, with its κ_s, its data and its prior, whose fixed point
minimises

    f_s(x_s) = κ_g,s ‖WΨ†x_s‖₁ + ½ Σ_j ‖y_j − Φ_j x_s‖²/σ_j²

by steps along c_s ∇f_s, c_s = κ_s/κ_g,s (:mod:`casa_sara.solver.l2_bounds`).  Together they minimise Σ_s f_s where the
bound holds if Step 17 projects on it in the metric that belongs to these steps:

    x ← arg min Σ_s |x_s − p_s|²/c_s   over |x| ≤ I,      p_s = z_s − τc_s∇f_s,

which is x_s = p_s/(1 + λc_s), λ such that |x| = I where |p| is larger: see `polarised_step` of the kernels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casa_sara.solver import _kernels as kernels
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds

__all__ = ["PolarisationBound"]


class PolarisationBound:
    """Steps of the iterations of some of Q, U and V, with |(Q, U, V)| ≤ I after each.

    Parameters
    ----------
    ppds : list of AdaptivePPD
        Their iterations, in one process.
    brightness : float32 (nx, ny)
        I in Jy/pixel, or what others leave of it; +∞ where there is no bound.
    """

    def __init__(self, ppds: Sequence[AdaptivePPD], brightness: np.ndarray) -> None:
        self._ppds, self._brightness = tuple(ppds), brightness
        self._before = tuple(np.empty_like(ppd.model) for ppd in ppds)
        self._sums = np.zeros((len(brightness), 4))

    def __len__(self) -> int:
        """Number of iterations."""
        return len(self._ppds)

    def step(self, bounds: Sequence[GivenBounds | AdaptiveBounds]) -> None:
        """Do one step of every iteration.

        Parameters
        ----------
        bounds : list of GivenBounds or AdaptiveBounds
            Those of each.
        """
        for ppd, before in zip(self._ppds, self._before):
            np.copyto(before, ppd.model)
            ppd.step()
        self._project(np.array([ppd.threshold / one.gradient_noise * ppd.unit_jy**2
                                for ppd, one in zip(self._ppds, bounds)]))
        for ppd, before in zip(self._ppds, self._before):
            ppd.measurement.workers.run(kernels.changes, ppd.model, before, self._sums)
            ppd.account_for([*self._sums[:, :3].sum(axis=0).tolist(), float(self._sums[:, 3].max())])

    def _project(self, metric):
        """Project all images, in the metric c_s, of which the scale does not matter."""
        models, bars, anchors = (tuple(getattr(ppd, name) for ppd in self._ppds)
                                 for name in ("model", "model_bar", "anchor"))
        units = np.array([ppd.unit_jy for ppd in self._ppds])
        self._ppds[0].measurement.workers.run(kernels.polarised_step, models, bars, anchors, self._brightness, units,
                                              metric / metric.max())
