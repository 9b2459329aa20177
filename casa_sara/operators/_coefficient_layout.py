"""How coefficients, filters and work space of the dictionary lie in memory, and which thread has which basis."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pywt

from casa_sara.operators import _wavelet_kernels as kernels

__all__ = ["aligned", "approximations", "displacement", "filter_lengths", "filters", "padded_shape", "rectangle",
           "shares"]

CACHE_LINE = 64


@cache
def displacement(wavelet, level):
    """Coefficients by which approximations 'a' and details 'd' of a level lie off the pixels that they describe."""
    size = 64 << level
    pixel = np.zeros(size)
    pixel[size // 2] = 1
    approximation, detail = pywt.wavedec(pixel, wavelet, mode="periodization", level=level)[:2]
    places = np.arange(approximation.size) - approximation.size // 2
    return {kind: int(np.rint(np.vdot(coefs**2, places) / np.vdot(coefs, coefs)))
            for kind, coefs in (("a", approximation), ("d", detail))}


def padded_shape(shape, levels):
    """The next multiples of 2**levels."""
    block = 1 << levels
    return tuple(-(-n // block) * block for n in shape)


def approximations(padded, levels, itemsize):
    """Pixels of the approximations of one basis."""
    nx, ny = padded
    return sum((nx >> level) * kernels.padded_width(ny >> level, itemsize) for level in range(1, levels))


def rectangle(band):
    """Basis, first row, end row, first column and end column of a band."""
    basis, rows, columns = band.slice
    return basis, rows.start, rows.stop, columns.start, columns.stop


def aligned(shape, dtype):
    """Zeros that begin on a cache line, on huge pages where the system offers them (np.zeros gives neither)."""
    size = int(np.prod(shape))
    buffer = np.empty(size + CACHE_LINE // dtype.itemsize, dtype)
    begin = -buffer.ctypes.data % CACHE_LINE // dtype.itemsize
    array = buffer[begin:begin + size].reshape(shape)
    array.fill(0)
    return array


def filters(wavelets, n_bases, dtype):
    """Lay the taps out as the kernels read them."""
    gain = 1 / np.sqrt(n_bases)
    lengths = filter_lengths(wavelets)
    analysis = np.zeros((2, len(wavelets), 2, kernels.MAX_TAPS))
    synthesis = np.zeros_like(analysis)
    for b, (name, length) in enumerate(zip(wavelets, lengths)):
        if length:
            wavelet = pywt.Wavelet(name)
            taps = np.array([wavelet.dec_lo[::-1], wavelet.dec_hi[::-1]])
            analysis[0, b, :, :length] = taps
            odd = length // 2 % 2  # even pixels meet the even taps, and the odd the odd
            even_pixels, odd_pixels = taps[:, 1 - odd::2], taps[:, odd::2]
            synthesis[0, b, 0, :length] = even_pixels[:, ::-1].T.ravel()
            synthesis[0, b, 1, :length] = odd_pixels[:, ::-1].T.ravel()
    analysis[1], synthesis[1] = gain * analysis[0], gain * synthesis[0]
    return kernels.Filters(lengths, analysis.astype(dtype), synthesis.astype(dtype), dtype.type(gain))


def filter_lengths(wavelets: Sequence[str]) -> np.ndarray:
    """Return the number of taps of each basis, int (b,), 0 for Dirac.

    Parameters
    ----------
    wavelets : sequence of str
        Names of the bases, 'dirac' or those of PyWavelets.

    Returns
    -------
    int64 (b,)
    """
    return np.array([0 if name == "dirac" else pywt.Wavelet(name).dec_len for name in wavelets], np.int64)


def shares(costs, workers):
    """Give every task to the worker with the least to do, the costly ones first."""
    owner, load = np.zeros(len(costs), np.int64), np.zeros(workers)
    for task in np.argsort(-costs, kind="stable"):
        owner[task] = np.argmin(load)
        load[owner[task]] += costs[task]
    return owner
