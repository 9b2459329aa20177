"""The Kaiser–Bessel kernel, used to interpolate between grid cells and to decimate images.

    φ(t) = I0(β √(1−t²)) / I0(β),  t ∈ [−1, 1];      w cells wide: φ(2x/w)

Its Fourier transform at ξ cycles per cell, ∫ φ(2x/w) exp(2πixξ) dx, is w·sinh(r)/(r·I0(β)) with
r = √(β² − (πwξ)²).  For signals that fill 1/σ of the band, β = π √(w²(1−1/2σ)² − 0.8) keeps the
aliases lowest (Beatty et al. 2005).
"""

from __future__ import annotations

import functools
from bisect import bisect_left

import numpy as np
import numpy.typing as npt
from scipy.special import i0

__all__ = ["alias_level", "gain", "kernel", "kernel_polynomial", "kernel_shape", "padding", "transform"]


def kernel_shape(width: int, sigma: float) -> float:
    """The shape β for `width` cells and a signal that fills 1/`sigma` of the band.

    Parameters
    ----------
    width : int
        Cells.
    sigma : float
        σ ≥ 1.

    Returns
    -------
    float
    """
    return np.pi * np.sqrt(max((width * (1 - 0.5 / sigma)) ** 2 - 0.8, 0.0))


def kernel(t: np.ndarray, beta: float | np.ndarray) -> np.ndarray:
    """φ(t), zero outside [−1, 1].

    Parameters
    ----------
    t : real, any shape
        Distance from the centre in cells.
    beta : float
        Shape β.

    Returns
    -------
    real, of the shape of t
    """
    return np.where(np.abs(t) <= 1, i0(beta * np.sqrt(np.maximum(1 - t**2, 0))), 0) / i0(beta)


def transform(xi: npt.ArrayLike, width: int, beta: float) -> np.ndarray:
    """Fourier transform of φ(2x/width) at `xi` cycles per cell.

    Parameters
    ----------
    xi : real, any shape
        Cycles per cell.
    width : int
        Cells.
    beta : float
        Shape β.

    Returns
    -------
    float64, of the shape of xi
    """
    square = beta**2 - (np.pi * width * np.asarray(xi, dtype=np.float64)) ** 2
    r = np.sqrt(np.abs(square))
    inside = np.sinh(np.where(square > 0, r, 0)) / np.where(r > 0, r, 1)
    return width * np.where(square > 0, inside, np.sinc(r / np.pi)) / i0(beta)


def alias_level(width: int, sigma: float) -> float:
    """Largest relative error of interpolation: root sum square of the aliases over the signal.

    Parameters
    ----------
    width : int
        Cells.
    sigma : float
        The signal fills 1/σ of the band.

    Returns
    -------
    float
    """
    beta = kernel_shape(width, sigma)
    xi = np.linspace(0, 0.5 / sigma, 33)
    orders = np.concatenate([np.arange(-16, 0), np.arange(1, 17)])
    aliases = transform(xi[:, None] + orders, width, beta)
    return np.max(np.sqrt(np.sum(aliases**2, axis=1)) / transform(xi, width, beta))


def gain(width: int, sigma: float) -> float:
    """Largest ratio of the kernel's transform over the signal.

    Parameters
    ----------
    width : int
        Cells.
    sigma : float
        The signal fills 1/σ of the band.

    Returns
    -------
    float
    """
    ends = transform([0, 0.5 / sigma], width, kernel_shape(width, sigma))
    return ends[0] / ends[1]


@functools.cache
def padding(width: int, eps: float, low: float = 1.1, high: float = 4.0) -> float:
    """Smallest σ ∈ [low, high], in steps of 1e-3, with which `width` cells reach the accuracy `eps`; inf if none does.

    Parameters
    ----------
    width : int
        Cells.
    eps : float
        Largest alias level.
    low, high : float
        Range of σ.

    Returns
    -------
    float
    """
    sigmas = np.arange(low, high, 1e-3)
    first = bisect_left(sigmas, -eps, key=lambda sigma: -alias_level(width, sigma))  # aliases fall with σ
    return float(sigmas[first]) if first < len(sigmas) else np.inf


def kernel_polynomial(width: int, beta: float, degree: int) -> np.ndarray:
    """The kernel at its `width` cells as polynomials of the position within a cell.

    Parameters
    ----------
    width : int
        Cells.
    beta : float
        Shape β.
    degree : int
        Of the polynomials.

    Returns
    -------
    float64 (degree + 1, width)
        Highest power first.  Cell k lies at x = k + (1−t)/2 − width/2 from the centre, t ∈ [−1, 1].
    """
    t = np.cos((np.arange(4 * degree) + 0.5) * np.pi / (4 * degree))
    x = np.arange(width) + (1 - t[:, None]) / 2 - width / 2
    fit = np.polynomial.chebyshev.chebfit(t, kernel(2 * x / width, beta), degree)
    powers = [np.polynomial.chebyshev.cheb2poly(column) for column in fit.T]  # without zeros at the end
    return np.stack([np.pad(row, (0, degree + 1 - row.size)) for row in powers], axis=1)[::-1]
