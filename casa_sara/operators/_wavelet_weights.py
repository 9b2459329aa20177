"""Compiled pass over wavelet coefficients that turns them into the weights of the ℓ1 prior."""

from __future__ import annotations

import numpy as np

from casa_sara.runtime import jit

__all__ = ["RING_ROWS", "neighbourhood_weights"]

RING_ROWS = 5  # sums of the three rows around, and of the first and the last row of the band
MATH = {"error_model": "numpy", "fastmath": {"contract", "arcp"}}

_compiled = jit.inner(**MATH)


@_compiled
def _row_sums(row, to):
    """Σ d² of every value and its two neighbours, periodic."""
    n = row.size
    for k in range(1, n - 1):
        to[k] = row[k - 1] * row[k - 1] + row[k] * row[k] + row[k + 1] * row[k + 1]
    for k in (0, n - 1):
        left, right = row[(k - 1) % n], row[(k + 1) % n]
        to[k] = left * left + row[k] * row[k] + right * right


@_compiled
def _row_weights(row, above, here, below, alpha, scale):
    """s·α/(α + d̄), d̄² the mean of nine squares."""
    ninth = row.dtype.type(1 / 9)
    for k in range(row.size):
        row[k] = scale * alpha / (alpha + np.sqrt(ninth * (above[k] + here[k] + below[k])))


@jit.kernel(**MATH)
def neighbourhood_weights(coefs, rectangles, params, ring, worker, workers):
    """Replace the coefficients d of every `workers`-th band by s·α/(α + d̄).

    d̄ is the root mean square over 3×3 coefficients, periodic in the band; `rectangles` tells where each band lies and
    `params` its α and s.  The sums of the rows that are overwritten already stay in `ring`.
    """
    for number in range(worker, len(rectangles), workers):
        basis, first, end, left, right = rectangles[number]
        band, sums = coefs[basis, first:end, left:right], ring[worker, :, : right - left]
        rows = band.shape[0]
        _row_sums(band[0], sums[0])
        _row_sums(band[0], sums[3])
        _row_sums(band[rows - 1], sums[4])
        alpha, scale = params[number]
        for i in range(rows):
            above = sums[4] if i == 0 else sums[(i - 1) % 3]
            if i + 1 < rows:
                below = sums[(i + 1) % 3]
                _row_sums(band[i + 1], below)
            else:
                below = sums[3]
            _row_weights(band[i], above, sums[i % 3], below, alpha, scale)
