"""Where positive pixels contradict the data: unresolved sources between pixels.

A source between pixels has, on the grid, the shape of a shifted sinc within the band of the data, with negative
lobes.  Positive pixels cannot hold it, and what they cannot hold stays in the residual, an error of tens of per cent of
the source at the longest baselines.  The lower bound of the pixels is lowered there, and only there.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import binary_dilation, maximum_filter

__all__ = ["Release"]

SIGNIFICANT = 5.0  # standard deviations of the noise
LOBE = 0.25  # deepest negative lobe of a shifted sinc: 0.217 of its peak
REACH = 3  # pixels around


class Release:
    """Lowers the bounds of pixels that the data want to be negative, as far as a source nearby explains it.

    The gradient of the data, weighted by density as the steps are so that it is local,

        g = Φ†UΣ⁻¹(y − Φx) / √(Σ_m U_m² w_m/σ_m²),

    is noise of unit variance where the model is right.  A pixel at its lower bound asks to be released where g < −5.  Where
    it asks in two calls one after the other (a model that still moves swings to either side), and up to 3 pixels around,
    the lower bound becomes −0.25 × the brightest pixel within 3 pixels.  What was released once stays so.
    """

    def __init__(self):
        self._wanted_before = np.zeros((), bool)

    def update(self, ppd, bounds):
        """Release what the residual of the present model asks for.

        Parameters
        ----------
        ppd : AdaptivePPD
            `lowest` is changed in place.
        bounds : GivenBounds or AdaptiveBounds

        Returns
        -------
        int
            Number of pixels with a negative lower bound that had none before.
        """
        wanted = _wanted(ppd, bounds)
        both, self._wanted_before = wanted & self._wanted_before, wanted
        if not both.any():
            return 0
        around = binary_dilation(both, np.ones((2 * REACH + 1, 2 * REACH + 1), bool))
        before = np.count_nonzero(ppd.lowest)
        lobes = LOBE * maximum_filter(ppd.model, 2 * REACH + 1)
        ppd.comm.settle()  # all ranks of one machine have counted, and write the same
        np.minimum(ppd.lowest, -lobes, out=ppd.lowest, where=around & (ppd.lowest < np.inf))
        ppd.comm.settle()
        return int(np.count_nonzero(ppd.lowest) - before)

    def state(self):
        """Return what the next call depends on."""
        return dict(wanted_before=self._wanted_before)

    def set_state(self, state):
        """Take over what :meth:`state` has returned."""
        self._wanted_before = np.array(state["wanted_before"])


def _wanted(ppd, bounds):
    """Which pixels ask to be released; bool (nx, ny)."""
    weights = ppd.precond * ppd.spread
    weights *= np.repeat(bounds.noise_weights.astype(weights.dtype), np.diff(ppd.offsets))
    image, vis = ppd.scratch_image, ppd.scratch_vis
    image.fill(0)
    image[0, 0] = 1
    ppd.measurement.forward(image, vis)
    vis *= ppd.precond * weights
    noise_sq = float(ppd.adjoint(vis, image)[0, 0])
    ppd.measurement.forward(ppd.model, vis)
    np.subtract(ppd.vis, vis, out=vis)
    vis *= weights
    gradient = ppd.adjoint(vis, image)
    return (gradient < -SIGNIFICANT * math.sqrt(noise_sq)) & (ppd.model <= ppd.lowest) & (ppd.lowest < np.inf)
