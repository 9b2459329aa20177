"""The cone of polarised brightness, |(Q, U, V)| ≤ I in every pixel, in iterations that are done side by side.

Each Stokes parameter s has an iteration of its own, with its κ_s, its data and its prior, whose fixed point minimises

    f_s(x_s) = κ_g,s ‖WΨ†x_s‖₁ + ½ Σ_j ‖y_j − Φ_j x_s‖²/σ_j²

by steps along c_s ∇f_s, c_s = κ_s/κ_g,s (:mod:`casa_sara.solver.l2_bounds`).  Together they minimise Σ_s f_s over the
cone where Step 17 projects on it in the metric that belongs to these steps:

    x ← arg min Σ_s |x_s − (z_s − τc_s∇f_s)|²/c_s   over I ≥ 0, |(Q, U, V)| ≤ I.

With a_s = c_s that is x_s = p_s/(1 + λa_s) for Q, U and V, and I = |(Q, U, V)|, λ the root of |p(λ)|(1 − λa_I) = p_I
(:func:`casa_sara.solver._kernels.cone_step`).  An iteration that has come to its end stays where it is, a_s = 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from casa_sara.solver import _kernels as kernels
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds

__all__ = ["PolarisationCone"]


class PolarisationCone:
    """Steps of the iterations of I and of some of Q, U and V, with |(Q, U, V)| ≤ I after each.

    There is no cone where I may be negative: around unresolved sources, which lie between pixels.

    Parameters
    ----------
    ppds : list of AdaptivePPD
        Those of I, which comes first, and of the others, in one process.
    """

    def __init__(self, ppds: Sequence[AdaptivePPD]) -> None:
        self._ppds = tuple(ppds)
        self._before = tuple(np.empty_like(ppd.model) for ppd in ppds)
        self._free = np.empty_like(ppds[0].model)
        self._sums = np.zeros((len(self._free), 4))

    def step(self, going: Mapping[int, GivenBounds | AdaptiveBounds]) -> None:
        """Do one step of the iterations that go on.

        Parameters
        ----------
        going : dict
            Number of an iteration → its bounds.
        """
        for number in going:
            np.copyto(self._before[number], self._ppds[number].model)
            self._ppds[number].step()
        if 0 in going:
            self._ppds[0].unprojected(self._free)
        self._project(self._metric(going))
        for number in going:
            ppd, sums = self._ppds[number], self._sums
            ppd.measurement.workers.run(kernels.changes, ppd.model, self._before[number], sums)
            ppd.account_for([*sums[:, :3].sum(axis=0).tolist(), float(sums[:, 3].max())])

    def _metric(self, going):
        """Return a_s in Jy², in units of the largest; 0 for an iteration that has ended."""
        metric = np.zeros(len(self._ppds))
        for number, bounds in going.items():
            ppd = self._ppds[number]
            metric[number] = ppd.threshold / bounds.gradient_noise * ppd.unit_jy**2
        return metric / metric.max()

    def _project(self, metric):
        """Project all images that go on."""
        first, units = self._ppds[0], np.array([ppd.unit_jy for ppd in self._ppds])
        models, bars, anchors = (tuple(getattr(ppd, name) for ppd in self._ppds)
                                 for name in ("model", "model_bar", "anchor"))
        first.measurement.workers.run(kernels.cone_step, models, bars, anchors, self._free,
                                      first.lowest, units, metric)
