"""The measurement operator Φ: model image to visibilities, and its adjoint.

A point source of unit flux at pixel (ix, iy) contributes to visibility m

    exp(+2πi (u_m l + v_m m)),   l = −(ix − nx//2)·cell_x,   m = (iy − ny//2)·cell_y,

with (u, v) in wavelengths and l (east), m (north) in radians.  This is the sign
convention of the MeasurementSet and of tclean, without the w-term.
"""

from __future__ import annotations

import finufft
import numpy as np

__all__ = ["MeasurementOperator"]

ARCSEC_PER_RAD = 180.0 * 3600.0 / np.pi


class MeasurementOperator:
    """Non-uniform Fourier transform of a real image, built once and applied often.

    Parameters
    ----------
    uv : float64 (2, M)
        Baselines in wavelengths.
    cell_rad : float or (float, float)
        Pixel size in radians, positive; one number, or one per image axis.
    shape : (int, int)
        Image size (nx, ny); images are indexed [ix, iy], ix grows to the west.
    row_scale : real (M,), optional
        Factor on each visibility, e.g. the square root of its weight for whitening.
    eps : float
        Relative accuracy of the transform.
    dtype : float32 or float64
        Of images; visibilities are complex of the same precision.
    nthreads : int
        Threads used by each transform.

    Raises
    ------
    ValueError
        `uv`, `shape`, `row_scale` unusable, or `cell` too large for the longest baseline.
    """

    def __init__(self, uv, cell_rad, shape, row_scale=None, eps=1e-6, dtype=np.float32, nthreads=1):
        uv = np.asarray(uv, dtype=np.float64)
        if uv.ndim != 2 or uv.shape[0] != 2 or uv.shape[1] == 0:
            raise ValueError(f"uv must have shape (2, M) with M >= 1, not {uv.shape}")
        self.shape = tuple(int(n) for n in shape)
        self.size = uv.shape[1]
        self.dtype = np.dtype(dtype)
        self.complex_dtype = np.result_type(self.dtype, np.complex64)
        cell = np.broadcast_to(np.asarray(cell_rad, dtype=np.float64), (2,))
        reach = np.abs(uv).max(axis=1)
        if np.any(reach * cell > 0.5):
            largest = ARCSEC_PER_RAD * 0.5 / reach.max()
            raise ValueError(f"cell={cell.max() * ARCSEC_PER_RAD:.4g} arcsec is too large for the longest "
                             f"baseline: use at most cell='{largest:.4g}arcsec'")
        self._row_scale = np.ones(self.size, self.dtype) if row_scale is None else np.array(row_scale, self.dtype)
        if self._row_scale.shape != (self.size,):
            raise ValueError(f"row_scale must have shape ({self.size},), not {self._row_scale.shape}")
        self._plan = finufft.Plan(2, self.shape, eps=eps, isign=1, dtype=self.complex_dtype.name, nthreads=nthreads)
        self._plan.setpts(np.ascontiguousarray(-2 * np.pi * cell[0] * uv[0], self.dtype),
                          np.ascontiguousarray(2 * np.pi * cell[1] * uv[1], self.dtype))
        self._image = np.zeros(self.shape, self.complex_dtype)
        self._vis = np.zeros(self.size, self.complex_dtype)

    def forward(self, image, out=None):
        """Visibilities Φ·image, complex (M,), of a real image (nx, ny)."""
        out = np.empty(self.size, self.complex_dtype) if out is None else out
        self._image[...] = image
        self._plan.execute(self._image, out)
        out *= self._row_scale
        return out

    def adjoint(self, vis, out=None):
        """Real image Re(Φ†·vis), (nx, ny), of complex visibilities (M,)."""
        out = np.empty(self.shape, self.dtype) if out is None else out
        np.multiply(vis, self._row_scale, out=self._vis)
        self._plan.execute_adjoint(self._vis, self._image)
        out[...] = self._image.real
        return out
