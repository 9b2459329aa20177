"""The measurement operator of a wide field, with the w-term.

    V_m = Σ I exp(2πi [u l + v m + w (n − 1)]),      n = √(1 − l² − m²),

exact to the accuracy asked for.  Two ways lead there: the factor exp(2πi w (n − 1)) as a short series of plain
transforms (`modulated.py`), and the w-gridder of the package ducc0 (Arras et al. 2021, Ye et al. 2022).  The number of
terms of the series grows with the largest phase, which therefore decides: `WTerm`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from casa_sara.operators._workers import Workers
from casa_sara.operators.measurement import SMALLEST_EPS, MeasurementOperator, check_cell
from casa_sara.operators.modulated import ModulatedOperator, bessel_factors, terms_needed

__all__ = ["WGridder", "WTerm", "w_operator"]

MOST_TERMS = 20  # the w-gridder takes the time of 17 to 60 plain transforms (benchmarks/widefield.py)
SPEED_OF_LIGHT = 299_792_458.0
SMALLEST_SINGLE = 1e-5  # accuracy below which ducc0 wants double precision
SMALLEST_SIDE = 32  # of ducc0's images, which have even sides


@dataclass(frozen=True)
class WTerm:
    """How the w-term is modelled.

    Attributes
    ----------
    phase : float
        Largest phase 2π|w|(1 − n), in rad, of data and field: what an operator without it is wrong by.
    depth : float
        Largest 1 − n in the image.
    terms : int
        Of the series, 0 for the w-gridder.
    """

    phase: float
    depth: float
    terms: int

    @classmethod
    def of(cls, max_w: float, shape: tuple[int, int], cell_rad: Sequence[float] | np.ndarray, eps: float) -> WTerm:
        """The way that takes least for |w| ≤ max_w, in wavelengths, an image and an accuracy.

        Parameters
        ----------
        max_w : float
            Largest |w| in wavelengths.
        shape : (int, int)
            Pixels of the image.
        cell_rad : (float, float)
            Pixel size in radians.
        eps : float
            Accuracy.

        Returns
        -------
        WTerm
        """
        depth = -float(_n_minus_1(*_cosines(shape, cell_rad, corners=True)).min())
        phase = 2 * np.pi * float(max_w) * depth
        terms = terms_needed(phase / 2, eps / 4)
        return cls(phase, depth, terms if terms <= MOST_TERMS else 0)

    @property
    def words(self) -> str:
        """The same for the log."""
        way = f"a series of {self.terms} Fourier transforms" if self.terms else "the w-gridder of ducc0"
        return f"w-term: changes phases by up to {self.phase:.3g} rad in this image, modelled by {way}"


def w_operator(uvw: np.ndarray, cell_rad: npt.ArrayLike, shape: tuple[int, int],
               row_scale: np.ndarray | None = None, eps: float = 1e-6, dtype: npt.DTypeLike = np.float32,
               nthreads: int = 1) -> ModulatedOperator | WGridder:
    """Return the measurement operator with the w-term.

    Parameters
    ----------
    uvw : float64 (3, M)
        Baselines in wavelengths.
    cell_rad, shape, row_scale, eps, dtype, nthreads
        As of :class:`casa_sara.operators.measurement.MeasurementOperator`.

    Returns
    -------
    ModulatedOperator or WGridder

    Raises
    ------
    ValueError
        As of `MeasurementOperator`, and for an image whose corners are beyond the horizon.
    """
    w, cell = uvw[2], np.broadcast_to(np.asarray(cell_rad, float), (2,))
    dtype = np.dtype(dtype)
    plan = WTerm.of(np.abs(w).max(), shape, cell, eps)
    if not plan.terms:
        return WGridder(uvw, cell, shape, row_scale, eps, dtype, nthreads)
    base = MeasurementOperator(uvw[:2], cell, shape, row_scale, max(eps / 2, SMALLEST_EPS[dtype]), dtype, nthreads)
    # exp(2πi w (n − 1)) = exp(−πi w d) exp(i c s) with d = max(1 − n), c = πwd and s = 1 − 2(1 − n)/d
    place = _n_minus_1(*_cosines(shape, cell))
    place *= 2 / max(plan.depth, np.finfo(float).tiny)
    place += 1
    turned = np.pi * plan.depth * w
    return ModulatedOperator(base, place.astype(dtype), bessel_factors(turned, plan.terms, dtype=dtype),
                             np.exp(-1j * turned).astype(base.complex_dtype), turning=True)


def _cosines(shape, cell_rad, corners=False):
    """Return l (nx, 1) and m (1, ny) of the pixels, or of the first and the last along each axis."""
    axes = [np.array([0, n - 1]) if corners else np.arange(n) for n in shape]
    l, m = ((axis - n // 2) * float(cell) for axis, n, cell in zip(axes, shape, cell_rad))
    return -l[:, None], m[None, :]


def _n_minus_1(l, m):
    """Return √(1 − l² − m²) − 1, without cancellation."""
    square = l**2 + m**2
    if square.max() >= 1:
        raise ValueError(f"imsize and cell make an image whose corners are beyond the horizon: l² + m² = "
                         f"{square.max():.3g} there; should be below 1, with fewer or smaller pixels")
    return -square / (1 + np.sqrt(1 - square))


class WGridder:
    """The w-gridder of ducc0 with the interface of `MeasurementOperator`.

    It allocates its grids in each call. With several threads the order of its sums, and with it the last bits of the
    adjoint, are not the same from call to call.

    Parameters
    ----------
    uvw, cell_rad, shape, row_scale, eps, dtype, nthreads
        As of :func:`w_operator`.
    """

    def __init__(self, uvw: np.ndarray, cell_rad: Sequence[float] | np.ndarray, shape: tuple[int, int],
                 row_scale: np.ndarray | None, eps: float, dtype: npt.DTypeLike, nthreads: int) -> None:
        from ducc0 import wgridder  # only where it is needed

        check_cell(uvw[:2], cell_rad)
        self._ducc = wgridder
        self.shape, self.size, self.dtype = tuple(int(n) for n in shape), uvw.shape[1], np.dtype(dtype)
        self.complex_dtype = np.result_type(self.dtype, np.complex64)
        self.workers = Workers(nthreads)
        if not SMALLEST_EPS[self.dtype] <= eps < 1:
            raise ValueError(f"eps={eps} must be at least {SMALLEST_EPS[self.dtype]} for {self.dtype}, and below 1")
        precise = np.dtype(np.float64) if eps < SMALLEST_SINGLE else self.dtype
        scale = None if row_scale is None else np.ascontiguousarray(row_scale, precise).reshape(-1, 1)
        self._common = dict(uvw=np.ascontiguousarray(uvw.T), freq=np.array([SPEED_OF_LIGHT]), wgt=scale,
                            pixsize_x=float(cell_rad[0]), pixsize_y=float(cell_rad[1]), epsilon=float(eps),
                            do_wgridding=True, flip_v=True, divide_by_n=False, nthreads=self.workers.count)
        sides = [max(SMALLEST_SIDE, n + n % 2) for n in self.shape]
        self._image = np.zeros(sides, precise)
        self._inner = self._image[tuple(slice(side // 2 - n // 2, side // 2 - n // 2 + n)
                                        for side, n in zip(sides, self.shape))]
        self._vis = np.empty((self.size, 1), np.result_type(precise, np.complex64))

    def forward(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the visibilities, complex (M,), of a real image (nx, ny), in `out` where given.

        Parameters
        ----------
        image : real (nx, ny)
            The image.
        out : array, optional
            Receives the result.

        Returns
        -------
        complex (M,)
        """
        if np.shape(image) != self.shape:
            raise ValueError(f"image must be of shape {self.shape}")
        out = np.empty(self.size, self.complex_dtype) if out is None else out
        self._image[...] = 0
        self._inner[...] = image
        self._ducc.dirty2vis(dirty=self._image, vis=self._vis, **self._common)
        out[...] = self._vis[:, 0]
        return out

    def adjoint(self, vis: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the real image (nx, ny), the adjoint for real inner products, of complex visibilities (M,).

        Parameters
        ----------
        vis : complex (M,)
            The visibilities.
        out : array, optional
            Receives the result.

        Returns
        -------
        real (nx, ny)
        """
        if np.shape(vis) != (self.size,):
            raise ValueError(f"vis must be of shape ({self.size},)")
        out = np.empty(self.shape, self.dtype) if out is None else out
        self._vis[:, 0] = vis
        self._ducc.vis2dirty(vis=self._vis, dirty=self._image, **self._common)
        out[...] = self._inner
        return out
