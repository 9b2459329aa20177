"""Unresolved sources between pixels, which non-negative pixels cannot represent.

A source between pixels has, on the grid, the shape of a shifted sinc within the band of the data, with negative
lobes.  Positive pixels cannot hold it, and what they cannot hold stays in the residual, an error of tens of per cent of
the source at the longest baselines.  The lower bound of the pixels is lowered there, and only there.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, maximum_filter

from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds

__all__ = ["Release"]

SIGNIFICANT = 3.0  # standard deviations of the noise
PERSISTENT = 0.5  # of what was asked for before
LOBE = 0.25  # deepest negative lobe of a shifted sinc: 0.217 of its peak
REACH = 3  # pixels around


class Release:
    """Lowers the bounds of pixels that the data want to be negative, as far as a source nearby explains it.

    The gradient of the data, weighted by density as the steps are so that it is local,

        g = Φ†UΣ⁻¹(y − Φx) / √(Σ_m U_m² w_m/σ_m²),

    is noise of unit variance where the model is right.  A pixel at its lower bound asks to be released where g < −3,
    and where a lobe of the brightest pixel within 3 pixels, −0.25 × its value, would change the gradient there by more
    than g. Where it asks in two calls one after the other, for at least half as much the second time (a model that
    still moves swings to either side, and what it leaves fades), and up to 3 pixels around, the lower bound becomes
    that lobe.  What was released once stays so.
    """

    def __init__(self):
        self._asked = np.zeros((), np.float32)  # g where a pixel asked in the last call, else 0

    def update(self, ppd: AdaptivePPD, bounds: GivenBounds | AdaptiveBounds) -> int:
        """Release what the residual of the present model asks for.

        Parameters
        ----------
        ppd : AdaptivePPD
            `lowest` is changed in place.
        bounds : GivenBounds or AdaptiveBounds
            Bounds of its blocks, from which the noise levels follow.

        Returns
        -------
        int
            Number of pixels with a negative lower bound that had none before.
        """
        around_pixel = (2 * REACH + 1, 2 * REACH + 1)
        lobes = LOBE * ppd.planes.each(lambda model: maximum_filter(model, around_pixel), ppd.model)
        asked, before = _asked(ppd, bounds, lobes), self._asked
        self._asked = asked
        again = (before < 0) & (asked < PERSISTENT * before)
        if not again.any():
            return 0
        around = ppd.planes.each(lambda one: binary_dilation(one, np.ones(around_pixel, bool)), again)
        count = np.count_nonzero(ppd.lowest)
        ppd.comm.barrier()  # all ranks of one machine have counted, and write the same
        np.minimum(ppd.lowest, -lobes, out=ppd.lowest, where=around & (ppd.lowest < np.inf))
        ppd.comm.barrier()
        return int(np.count_nonzero(ppd.lowest) - count)

    def state(self) -> dict[str, Any]:
        """Return what the next call depends on."""
        return dict(asked=self._asked)

    def set_state(self, state: dict[str, Any]) -> None:
        """Take over what :meth:`state` has returned.

        Parameters
        ----------
        state : dict
            As :meth:`state` has returned it.
        """
        self._asked = np.array(state["asked"])


def _asked(ppd, bounds, lobes):
    """The gradient g where a pixel asks to be released, 0 elsewhere; real (nx, ny)."""
    weights = ppd.precond * np.repeat(bounds.noise_weights.astype(ppd.precond.dtype), np.diff(ppd.offsets))
    image, vis = ppd.scratch_image, ppd.scratch_vis
    # what a pixel of 1 changes in its gradient, Σ U w/σ², and the variance of the gradient, Σ U² w/σ²
    place = (0, 0) if ppd.sky_over_image is None else tuple(
        n // 2 for n in ppd.planes.split(image).shape[1:])  # one that is seen
    ppd.planes.set_pixel(image, place)
    ppd.measurement.forward(image, vis)
    power = np.abs(vis)
    power *= power
    power *= weights
    response = ppd.comm.total(float(power.sum(dtype=float)))
    noise = math.sqrt(ppd.comm.total(float(np.vdot(power, ppd.precond))))
    ppd.measurement.forward(ppd.model, vis)
    np.subtract(ppd.vis, vis, out=vis)
    vis *= weights
    gradient = ppd.adjoint(vis, image)
    gradient /= gradient.dtype.type(noise)
    asks = (gradient < -SIGNIFICANT) & (lobes * (response / noise) > -gradient)
    return gradient * (asks & (ppd.model <= ppd.lowest) & (ppd.lowest < np.inf))
