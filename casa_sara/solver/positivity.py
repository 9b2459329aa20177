"""Where positive pixels contradict the data: unresolved sources between pixels.

A source between pixels has, on the grid, the shape of a shifted sinc within the band of the data, with negative
lobes.  Positive pixels cannot hold it, and what they cannot hold stays in the residual, an error of tens of per cent of
the source at the longest baselines.  The lower bound of the pixels is lowered there, and only there.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, maximum_filter

__all__ = ["release_beside_sources"]

SIGNIFICANT = 5.0  # standard deviations of the noise
LOBE = 0.25  # deepest negative lobe of a shifted sinc: 0.217 of its peak
REACH = 3  # pixels around


def release_beside_sources(ppd, bounds):
    """Lower the bounds of pixels that the data want to be negative, as far as a source nearby explains it.

    The gradient of the data, weighted by density as the steps are so that it is local,

        g = Φ†UΣ⁻¹(y − Φx) / √(Σ_m U_m² w_m/σ_m²),

    is noise of unit variance where the model is right.  Where g < −5, and up to 3 pixels around, the lower bound becomes
    −0.25 × the brightest pixel within 3 pixels.  What was released once stays so.

    Parameters
    ----------
    ppd : AdaptivePPD
        `lowest` is changed in place.
    bounds : GivenBounds or AdaptiveBounds

    Returns
    -------
    int
        Number of pixels with a negative lower bound that were not released before.
    """
    weights = ppd.precond * np.repeat(bounds.noise_weights, np.diff(ppd.offsets)).astype(ppd.precond.dtype)
    centre = np.zeros_like(ppd.model)
    centre[0, 0] = 1
    noise_sq = ppd.measurement.adjoint(ppd.precond * weights * ppd.measurement.forward(centre))[0, 0]
    gradient = ppd.measurement.adjoint(weights * (ppd.vis - ppd.measurement.forward(ppd.model)))
    wanted = gradient < -SIGNIFICANT * np.sqrt(noise_sq)
    if not wanted.any():
        return 0
    wanted = binary_dilation(wanted, np.ones((2 * REACH + 1, 2 * REACH + 1), bool))
    before = np.count_nonzero(ppd.lowest)
    lobes = LOBE * maximum_filter(ppd.model, 2 * REACH + 1) * wanted
    np.minimum(ppd.lowest, -lobes, out=ppd.lowest)
    return np.count_nonzero(ppd.lowest) - before
