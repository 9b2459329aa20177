"""Non-uniform FFT: from samples on a grid to arbitrary frequencies, and its transpose.

With complex samples z[i, j] at integer positions i, j (negative ones too) the transform is

    c_m = s_m · Σ_ij z[i, j] · exp(+2πi (f_m i + g_m j)),      f, g in cycles per sample,

where s_m scales the real and the imaginary part separately, so that it can conjugate.  The
samples are divided by the transform of a Kaiser–Bessel kernel, padded with zeros, Fourier
transformed, and interpolated with the kernel at (f_m, g_m).  Its aliases set the relative error;
width of the kernel and padding are chosen for the least work at the accuracy asked for.

Cell numbers and fractions of a cell are kept apart, so that in single precision the error
does not grow with the size of the image.  All memory is allocated once.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from numba import njit

from casa_sara.operators import kaiser_bessel
from casa_sara.operators._gridding_vectors import (
    element, load, multiply, multiply_add, pair_sums, polynomials, scale_pairs, store)

__all__ = ["NonUniformFFT"]

TILE_ROWS = 16
MAX_COLUMN_FREQUENCY = 0.42


class NonUniformFFT:
    """One grid, one set of frequencies, both directions.

    Forward: `clear`, write sample (i, j) times row_factors[i]·column_factors[j] into
    grid[rows[i], columns[j]], `to_points`.  Transpose: `from_points`, read the samples there.

    Parameters
    ----------
    frequencies : float64 (2, M)
        Cycles per sample: |f| ≤ 0.5 along rows, |g| ≤ 0.42 along columns.
    scales : real (M, 2)
        Factors on the real and imaginary parts of the result.
    starts, counts : (int, int)
        Samples are at positions starts[k] … starts[k] + counts[k] − 1 along axis k, 0 among them.
    eps : float
        Relative accuracy.
    dtype : float32 or float64
    workers : Workers
    """

    def __init__(self, frequencies, scales, starts, counts, eps, dtype, workers):
        self._workers = workers
        width, sigma, lengths = _least_work(frequencies.shape[1], starts, counts, eps, dtype)
        self._width, self._lanes = (0,) * width, (0,) * _lanes(width)
        self._halo, self._lengths = width // 2 + 1, lengths
        self._stride = 2 * (lengths[1] + 4)  # in reals; rows of 2^k cells would share cache lines
        self._place_points(frequencies, scales, dtype)
        self._allocate(dtype)
        beta = kaiser_bessel.kernel_shape(width, sigma)
        self._set_kernel(beta, dtype)
        self._place_samples(starts, counts, beta)

    def _place_points(self, frequencies, scales, dtype):
        """Sort the points by rows of tiles; keep first cell, place within it, scales."""
        place = (frequencies + 0.5) * np.array(self._lengths)[:, None] - len(self._width) / 2
        place[0] += self._halo
        first = np.ceil(place)
        row, column = first.astype(np.int64)
        order = np.argsort(row // TILE_ROWS, kind="stable")
        self._order = order.astype(np.int32)
        self._first = (row * self._stride + 2 * column)[order]
        self._within = np.ascontiguousarray((1 - 2 * (first - place)).T[order].astype(dtype))
        self._scales = np.ascontiguousarray(scales[order].astype(dtype))
        self._used = slice(column.min(), column.max() + len(self._lanes) // 2)

    def _allocate(self, dtype):
        """The grid and, for each worker but the first, a private piece of it to spread to."""
        count, height = self._workers.count, self._lengths[0] + 2 * self._halo
        self._shares = np.linspace(0, self._first.size, count + 1).astype(np.int64)
        self._pieces = np.zeros((count, 3), np.int64)  # first row, last row + 1, offset in memory minus that in the grid
        rows, end = self._first // self._stride, height * self._stride
        for k, (low, high) in enumerate(zip(self._shares[1:-1], self._shares[2:]), start=1):
            if high > low:
                span = rows[low:high].min(), rows[low:high].max() + len(self._width)
                self._pieces[k] = *span, end - span[0] * self._stride
                end += (span[1] - span[0]) * self._stride
        self._memory = np.zeros(end, dtype)
        cells = self._memory[: height * self._stride].view(np.result_type(dtype, np.complex64))
        self.grid = cells.reshape(height, -1)[:, : self._lengths[1]]

    def _set_kernel(self, beta, dtype):
        width, lanes = len(self._width), len(self._lanes)
        polynomial = kaiser_bessel.kernel_polynomial(width, beta, width + 1)
        self._terms = (0,) * len(polynomial)
        coefs = np.zeros((len(polynomial), lanes), dtype)
        coefs[:, : 2 * width] = np.repeat(polynomial, 2, axis=1)
        self._coefs = coefs.ravel()

    def _place_samples(self, starts, counts, beta):
        """Where samples go in the grid, and their factors; (−1)^i moves frequency 0 to its middle."""
        positions = [start + np.arange(count) for start, count in zip(starts, counts)]
        self.rows, self.columns = self._halo + positions[0] % self._lengths[0], positions[1] % self._lengths[1]
        self.row_factors, self.column_factors = (
            (1 - 2.0 * (p % 2)) / kaiser_bessel.transform(p / length, len(self._width), beta)
            for p, length in zip(positions, self._lengths))
        inner = self.grid[self._halo : self._halo + self._lengths[0]]
        self._filled = [part for part in (inner[: starts[0] + counts[0]], inner[starts[0] :] if starts[0] else inner[:0])
                        if part.size]

    def clear(self):
        """Fill the grid with zeros."""
        self._workers.run(_clear, self._memory)

    def to_points(self, out):
        """Transform the samples in `grid` into `out`, contiguous complex (M,)."""
        for part in self._filled:
            self._fft(part, 1, scipy.fft.ifft)
        used, halo, length = self.grid[:, self._used], self._halo, self._lengths[0]
        self._fft(used[halo : halo + length], 0, scipy.fft.ifft)
        used[:halo] = used[length : length + halo]
        used[length + halo :] = used[halo : 2 * halo]
        self._workers.run(_interpolate, self._memory, self._stride, self._first, self._within, self._coefs, self._scales,
                          self._order, _real_pairs(out), self._shares, self._width, self._lanes, self._terms)

    def from_points(self, values):
        """Transpose of `to_points`, from `values`, contiguous complex (M,)."""
        self.clear()
        self._workers.run(_spread, self._memory, self._stride, self._first, self._within, self._coefs, self._scales,
                          self._order, _real_pairs(values), self._shares, self._pieces, self._width, self._lanes,
                          self._terms)
        if self._workers.count > 1:
            self._workers.run(_add_pieces, self._memory, self._stride, self._pieces, len(self.grid))
        used, halo, length = self.grid[:, self._used], self._halo, self._lengths[0]
        used[length : length + halo] += used[:halo]
        used[halo : 2 * halo] += used[length + halo :]
        self._fft(used[halo : halo + length], 0, scipy.fft.fft)
        for part in self._filled:
            self._fft(part, 1, scipy.fft.fft)

    def _fft(self, view, axis, transform):
        """Unscaled FFT in place."""
        norm = "forward" if transform is scipy.fft.ifft else "backward"
        result = transform(view, axis=axis, norm=norm, overwrite_x=True, workers=self._workers.count)
        if not np.may_share_memory(result, view):
            view[...] = result


def _lanes(width):
    return 16 if width <= 8 else 32


def _real_pairs(values):
    """View of contiguous complex (M,) as real (M, 2)."""
    return values.view(values.real.dtype).reshape(-1, 2)


def _least_work(n_points, starts, counts, eps, dtype):
    """Kernel width, padding σ and grid lengths that take the least time (weights measured, in ns).

    Round-off is amplified where the transform of the kernel is small; kernels with too much of that are left out.
    """
    largest_gain = 3 * np.sqrt(eps / np.finfo(dtype).eps)
    extents = 1 + 2 * np.maximum(np.negative(starts), np.add(starts, counts) - 1)
    plans = []
    for width in range(4, 17):
        sigma = kaiser_bessel.padding(width, eps)
        if np.isfinite(sigma) and kaiser_bessel.gain(width, sigma) < largest_gain:
            margin = (_lanes(width) // 2 + 1) / (0.5 - MAX_COLUMN_FREQUENCY)
            least = np.maximum(np.ceil(sigma * extents), (4 * (width // 2 + 1), margin)).astype(int)
            lengths = tuple(2 * scipy.fft.next_fast_len(int(n + 1) // 2) for n in least)
            points = n_points * (4 + 2.5 * width * _lanes(width) / 16)
            plans.append((points + 0.8 * np.prod(lengths) * np.log2(np.prod(lengths)), width, sigma, lengths))
    if not plans:
        raise ValueError(f"eps={eps} is too small to be reached in {np.dtype(dtype)}")
    return min(plans)[1:]


_jit = njit(nogil=True, cache=True)


@_jit
def _share(size, worker, workers):
    return size * worker // workers, size * (worker + 1) // workers


@_jit
def _clear(memory, worker, workers):
    low, high = _share(memory.size, worker, workers)
    memory[low:high] = 0


@_jit
def _interpolate(cells, stride, first, within, coefs, scales, order, values, shares, width, lanes, terms, worker, workers):
    for p in range(shares[worker], shares[worker + 1]):
        kernel = polynomials(coefs, within[p, 0], terms, lanes)
        total = scale_pairs(load(cells, first[p], lanes), element(kernel, 0), element(kernel, 0))
        for i in range(1, len(width)):
            total = multiply_add(load(cells, first[p] + i * stride, lanes), element(kernel, 2 * i), total)
        real, imag = pair_sums(multiply(total, polynomials(coefs, within[p, 1], terms, lanes)))
        values[order[p], 0] = scales[p, 0] * real
        values[order[p], 1] = scales[p, 1] * imag


@_jit
def _spread(cells, stride, first, within, coefs, scales, order, values, shares, pieces, width, lanes, terms, worker, workers):
    for p in range(shares[worker], shares[worker + 1]):
        kernel = polynomials(coefs, within[p, 0], terms, lanes)
        row = scale_pairs(polynomials(coefs, within[p, 1], terms, lanes),
                          scales[p, 0] * values[order[p], 0], scales[p, 1] * values[order[p], 1])
        cell = first[p] + pieces[worker, 2]
        for i in range(len(width)):
            store(cells, cell, multiply_add(row, element(kernel, 2 * i), load(cells, cell, lanes)))
            cell += stride


@_jit
def _add_pieces(memory, stride, pieces, height, worker, workers):
    low, high = _share(height, worker, workers)
    for k in range(1, len(pieces)):
        start, stop = max(low, pieces[k, 0]) * stride, min(high, pieces[k, 1]) * stride
        for cell in range(start, stop):
            memory[cell] += memory[cell + pieces[k, 2]]
