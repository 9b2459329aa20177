"""The measurement operator of an image: two-dimensional, with the w-term, of a mosaic, with a spectrum, with outliers.

Where the brightness follows a power law of the frequency with a known index,

    I(ν) = I(ν0)·(ν/ν0)^α,

the image is that at ν0.  One α for the whole image is a factor on each sample; an image of α is a short sum of
transforms (`modulated.py`), since (ν/ν0)^α = exp(c s) with s the place of α within its range.
"""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from casa_sara.operators._workers import Workers
from casa_sara.operators.measurement import SMALLEST_EPS, MeasurementOperator, NoVisibilities, share_of
from casa_sara.operators.modulated import ModulatedOperator, bessel_factors, terms_needed
from casa_sara.operators.mosaic import MosaicOperator
from casa_sara.operators.outliers import ImagesOperator, operator_of_images
from casa_sara.operators.subbands import SubbandOperator
from casa_sara.operators.widefield import WGridder, WTerm, w_operator
from casa_sara.options import LARGEST_INDEX, ImageGrid
from casa_sara.parallel.serial import SERIAL, Serial

__all__ = ["further_bytes", "sky_operator"]

# bytes of one sample and of one pixel, beyond what the plain operator has
SERIES_SAMPLE, SERIES_PIXEL = 16, 16  # rotation and one term; place, two polynomials and one image
GRIDDER_SAMPLE, GRIDDER_PIXEL = 80, 80  # what it holds, and the grids and indices of a call
MOSAIC_SAMPLE, MOSAIC_PIXEL = 24, 24  # rotation, index and beam, and the visibilities of one beam; images of flat noise


def sky_operator(uvw: np.ndarray, grid: ImageGrid,  # noqa: PLR0913 - seven have a default
                 freq_hz: np.ndarray | None = None, row_scale: np.ndarray | None = None, eps: float = 1e-6,
                 dtype: npt.DTypeLike = np.float32,
                 nthreads: int | Workers = 1, comm: Serial = SERIAL, beam: np.ndarray | None = None,
                 ) -> (MeasurementOperator | ModulatedOperator | MosaicOperator | SubbandOperator | ImagesOperator
                       | WGridder | NoVisibilities):
    """Return the measurement operator of an image, with its outliers where it has some.

    Parameters
    ----------
    uvw : float64 (3, M)
        Baselines in wavelengths.
    grid : casa_sara.options.ImageGrid
        `shape`, `cell_rad`, `gridder`, `mosaic`, `spectrum`, `subbands` and `outliers` decide.
    freq_hz : real (M,), optional
        Frequencies; without them the sky is as bright at all frequencies as at the reference.
    row_scale, eps, dtype, nthreads
        As of :class:`casa_sara.operators.measurement.MeasurementOperator`, whose interface the result has.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the visibilities are spread; the result is of this rank's.
    beam : int (M,), optional
        Number of the primary beam of each sample, of a mosaic.

    Returns
    -------
    MeasurementOperator, ModulatedOperator, MosaicOperator, SubbandOperator, ImagesOperator, WGridder or NoVisibilities
    """
    def of_place(row_scale, eps):
        if grid.mosaic is not None:
            count = nthreads.count if isinstance(nthreads, Workers) else nthreads
            return MosaicOperator(uvw, np.asarray(beam), grid.mosaic, row_scale, eps, dtype, count, comm)
        return _of_place(uvw, grid, row_scale, eps, dtype, nthreads, comm)

    if grid.subbands is not None and freq_hz is not None:
        return SubbandOperator(of_place(row_scale, eps), grid.subbands.factors(freq_hz))
    spectrum = grid.spectrum if freq_hz is not None else None
    if spectrum is None:
        return of_place(row_scale, eps)
    ratio = np.log(np.asarray(freq_hz, np.float64) / spectrum.reference_hz)
    if np.ndim(spectrum.index) == 0:
        scale = np.exp(float(spectrum.index) * ratio)
        return of_place(scale if row_scale is None else scale * row_scale, eps)
    if np.shape(spectrum.index) != grid.shape:
        raise ValueError(f"spectralindex must have the shape {grid.shape} of the image, not {np.shape(spectrum.index)}")
    base = of_place(row_scale, max(eps / 2, SMALLEST_EPS[np.dtype(dtype)]))
    if not base.size:
        return base
    # (ν/ν0)^α = (ν/ν0)^α0 exp(c s), with α = α0 + h s and c = h ln(ν/ν0)
    low, high = float(np.min(spectrum.index)), float(np.max(spectrum.index))
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    terms = terms_needed(half * np.abs(ratio).max(), eps / 4, modified=True)
    factors = bessel_factors(half * ratio, terms, modified=True, dtype=np.dtype(dtype))
    factors *= np.exp(middle * ratio)
    place = (np.asarray(spectrum.index, np.float64) - middle) / max(half, np.finfo(float).tiny)
    return ModulatedOperator(base, place.astype(dtype), factors)


def _of_place(uvw, grid, row_scale, eps, dtype, nthreads, comm):
    """The operator of a sky that does not change with frequency."""
    if grid.outliers:
        return operator_of_images(uvw, grid, lambda uvw, grid, workers: _of_place(
            uvw, grid, row_scale, eps, dtype, workers if workers and grid.gridder == "standard" else nthreads, comm))
    if grid.gridder == "standard":
        return share_of(uvw[:2], grid.cell_rad, grid.shape, row_scale=row_scale, eps=eps, dtype=dtype,
                        nthreads=nthreads,
                        comm=comm)
    if not uvw.shape[1] and comm.size > 1:
        return NoVisibilities(grid.shape, dtype, nthreads)
    return w_operator(uvw, grid.cell_rad, grid.shape, row_scale, eps, dtype, nthreads)


def further_bytes(samples: int, grid: Any, max_w: float = 0.0, band: float = 0.0, eps: float = 1e-6) -> int:
    """Memory of the operator beyond that of the plain one, in single precision.

    Parameters
    ----------
    samples : int
        Number of visibilities.
    grid : casa_sara.options.ImageGrid
        `shape`, `cell_rad` and `gridder` decide.
    max_w : float
        Largest |w| in wavelengths.
    band : float
        Largest |ln(ν/ν0)|; 0 unless there is an image of the spectral index.
    eps : float
        Accuracy of the operator.

    Returns
    -------
    int
    """
    pixels, size = prod(grid.shape), 0
    if grid.gridder == "wproject":
        terms = WTerm.of(max_w, grid.shape, grid.cell_rad, eps).terms
        size += (SERIES_SAMPLE + 4 * terms) * samples + SERIES_PIXEL * pixels if terms else \
            GRIDDER_SAMPLE * samples + GRIDDER_PIXEL * pixels
    if grid.gridder == "mosaic":
        size += MOSAIC_SAMPLE * samples + MOSAIC_PIXEL * pixels
    if band > 0:
        terms = terms_needed(LARGEST_INDEX * band, eps / 4, modified=True)
        size += (SERIES_SAMPLE + 4 * terms) * samples + SERIES_PIXEL * pixels
    return int(size)
