"""Non-uniform FFT: from samples on a grid to arbitrary frequencies, and its transpose.

With complex samples z[i, j] at integer positions i, j (negative ones too) the transform is

    c_m = s_m · Σ_ij z[i, j] · exp(+2πi (f_m i + g_m j)),      f, g in cycles per sample,

where s_m scales the real and the imaginary part separately, so that it can conjugate.  The
samples are divided by the transform of a Kaiser–Bessel kernel, padded with zeros, Fourier
transformed, and interpolated with the kernel at (f_m, g_m).  Its aliases set the relative error;
width of the kernel and padding are chosen for the least work at the accuracy asked for.

Cell numbers and fractions of a cell are kept apart, so that in single precision the error
does not grow with the size of the image.  All memory is allocated once.  The points are spread to the grid in
pieces whose number depends on that of the points alone, so that results are the same, to the last bit, for any number
of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.fft

from casa_sara.operators import kaiser_bessel
from casa_sara.operators._gridding_vectors import (
    gather_rows,
    pair_sums,
    polynomials,
    scale_pairs,
    scatter_rows,
    second_half_twice,
)
from casa_sara.operators._workers import Workers
from casa_sara.runtime import jit

__all__ = ["NonUniformFFT", "memory_size"]

TILE_ROWS = 16
MOST_PIECES, PIECE_POINTS = 16, 5000
MAX_COLUMN_FREQUENCY = 0.42
CLEAR_NS, ADD_NS, FFT_NS, POINT_NS = 0.09, 0.5, 2.0, 10.0  # on one thread, of a real, a real, a cell and a point


class NonUniformFFT:
    """One grid, one set of frequencies, both directions.

    Forward: `clear`, write sample (i, j) times factors0[i]·factors1[j] into grid[cells0[i], cells1[j]],
    with ((cells0, factors0), (cells1, factors1)) = `placement`, then `to_points`.  Transpose: `from_points`,
    read the samples there.

    Parameters
    ----------
    frequencies : float64 (2, M)
        Cycles per sample: |f| ≤ 0.5 along rows, |g| ≤ 0.42 along columns.
    scales : real (M, 2)
        Factors on the real and imaginary parts of the result, float32 or float64 as this is.
    starts, counts : (int, int)
        Samples are at positions starts[k] … starts[k] + counts[k] − 1 along axis k, 0 among them.
    eps : float
        Relative accuracy.
    workers : Workers
    n_points : int, optional
        For how many points the plan is made, M unless given.
    """

    def __init__(self, frequencies: np.ndarray, scales: np.ndarray, starts: Sequence[int], counts: Sequence[int],
                 eps: float, workers: Workers, n_points: int | None = None) -> None:
        self._workers, dtype = workers, scales.dtype
        width, sigma, self._lengths = _least_work(n_points or frequencies.shape[1], starts, counts, eps, dtype)
        beta = kaiser_bessel.kernel_shape(width, sigma)
        self._kernel = _kernel(width, beta, dtype)
        self._halo = width // 2 + 1
        self._stride = _stride(self._lengths)
        self._place_points(frequencies, scales, width, dtype)
        self._allocate(width, dtype)
        self._place_samples(starts, counts, width, beta)

    def _place_points(self, frequencies, scales, width, dtype):
        """Sort the points by rows of tiles and share them out."""
        place = frequencies + 0.5
        place *= np.array(self._lengths)[:, None]
        place -= width / 2
        place[0] += self._halo
        row, column = cells = np.ceil(place).astype(np.int32)
        place -= cells  # −1 … 0
        order = np.argsort(row // TILE_ROWS, kind="stable")
        first = row[order] * np.int64(self._stride)
        first += 2 * column[order]
        self._points = Points(
            first=first,
            within=np.ascontiguousarray((1 + 2 * place.astype(dtype)).T[order]),
            scales=scales[order].astype(dtype, copy=False),
            order=order.astype(np.int32),
            shares=np.linspace(0, order.size, _pieces(order.size) + 1).astype(np.int64))
        self._used = slice(column.min(), column.max() + len(self._kernel.lanes) // 2)

    def _allocate(self, width, dtype):
        """The grid and, for each share of the points but the first, a piece of it to spread to."""
        height, shares = self._lengths[0] + 2 * self._halo, self._points.shares
        rows, end = self._points.first // self._stride, height * self._stride
        self._pieces = np.zeros((len(shares) - 1, 3), np.int64)  # first row, last row + 1, distance from the grid
        for piece, (low, high) in enumerate(zip(shares[1:-1], shares[2:]), start=1):
            top, bottom = rows[low:high].min(), rows[low:high].max() + width
            self._pieces[piece] = top, bottom, end - top * self._stride
            end += (bottom - top) * self._stride
        self._memory, self._height = np.zeros(end, dtype), height
        self._lay_out_grid()

    def _lay_out_grid(self):
        """The grid at the beginning of the memory."""
        self._cells = self._memory[: self._height * self._stride]
        complex_cells = self._cells.view(np.result_type(self._cells.dtype, np.complex64))
        self.grid = complex_cells.reshape(self._height, -1)[:, : self._lengths[1]]

    @property
    def memory_size(self) -> int:
        """Number of reals in the grid and the pieces."""
        return self._memory.size

    def points_in(self, empty: Callable[..., np.ndarray]) -> None:
        """Keep what there is of each point in other memory.

        Parameters
        ----------
        empty : callable
            Makes an array from shape and dtype.
        """
        moved = []
        for array in self._points:
            moved.append(empty(array.shape, array.dtype))
            moved[-1][...] = array
        self._points = Points(*moved)

    def work_in(self, memory: np.ndarray) -> None:
        """Work in this memory from now on, which others may use between the calls.

        Parameters
        ----------
        memory : real (n,)
            n is at least `memory_size`.
        """
        self._memory = memory[: self._memory.size]
        self._lay_out_grid()
        self._find_filled()

    def _place_samples(self, starts, counts, width, beta):
        """Where samples go in the grid, and their factors; (−1)^i moves frequency 0 to its middle."""
        positions = [start + np.arange(count) for start, count in zip(starts, counts)]
        self.placement = [
            (offset + p % length, (1 - 2.0 * (p % 2)) / kaiser_bessel.transform(p / length, width, beta))
            for p, length, offset in zip(positions, self._lengths, (self._halo, 0))]
        self._rows_filled = starts[0] + counts[0], self._lengths[0] + starts[0]
        self._find_filled()

    def _find_filled(self):
        """The rows of the grid that hold samples."""
        inner = self.grid[self._halo : self._halo + self._lengths[0]]
        parts = inner[: self._rows_filled[0]], inner[self._rows_filled[1] :]
        self._filled = [part for part in parts if part.size]

    def clear(self) -> None:
        """Fill the grid with zeros."""
        self._workers.run(_clear, self._cells, work_ns=CLEAR_NS * self._cells.size)

    def to_points(self, out: np.ndarray) -> None:
        """Transform the samples in `grid` into `out`, contiguous complex (M,).

        Parameters
        ----------
        out : complex (M,)
            Receives the values, in the order of the points as they were given.
        """
        for part in self._filled:
            self._fft(part, 1, scipy.fft.ifft)
        used, halo, length = self.grid[:, self._used], self._halo, self._lengths[0]
        self._fft(used[halo : halo + length], 0, scipy.fft.ifft)
        used[:halo] = used[length : length + halo]
        used[length + halo :] = used[halo : 2 * halo]
        self._workers.run(_interpolate, self._memory, self._stride, self._points, self._kernel, _real_pairs(out),
                          work_ns=POINT_NS * len(out))

    def from_points(self, values: np.ndarray) -> None:
        """Transpose of `to_points`, from `values`, contiguous complex (M,).

        Parameters
        ----------
        values : complex (M,)
            In the order of the points as they were given.
        """
        self.clear()
        self._workers.run(_spread, self._memory, self._stride, self._points, self._kernel, self._pieces,
                          _real_pairs(values), work_ns=POINT_NS * len(values))
        self._workers.run(_add_pieces, self._memory, self._stride, self._pieces, len(self.grid),
                          work_ns=ADD_NS * (self._memory.size - self._cells.size))
        used, halo, length = self.grid[:, self._used], self._halo, self._lengths[0]
        used[length : length + halo] += used[:halo]
        used[halo : 2 * halo] += used[length + halo :]
        self._fft(used[halo : halo + length], 0, scipy.fft.fft)
        for part in self._filled:
            self._fft(part, 1, scipy.fft.fft)

    def _fft(self, view, axis, transform):
        """Unscaled FFT in place."""
        self._workers.run(_fft_lines, view if axis else view.T, transform, work_ns=FFT_NS * view.size)


class Points(NamedTuple):
    """The frequencies, sorted, as the compiled kernels take them."""

    first: np.ndarray  # int64 (M,), index in memory of the first cell under the kernel
    within: np.ndarray  # real (M, 2), place in that cell, −1 … 1
    scales: np.ndarray  # real (M, 2)
    order: np.ndarray  # int32 (M,), number of the point before sorting
    shares: np.ndarray  # int64 (pieces + 1,), the points of each piece


class Kernel(NamedTuple):
    """Polynomials of the place within a cell; the lengths of tuples are constants to the compiler."""

    coefs: np.ndarray  # real, (len(terms), len(lanes)/2) flattened
    terms: tuple
    lanes: tuple
    width: tuple


def _kernel(width, beta, dtype):
    polynomial = kaiser_bessel.kernel_polynomial(width, beta, width + 1)
    coefs = np.zeros((len(polynomial), _lanes(width) // 2), dtype)
    coefs[:, :width] = polynomial
    return Kernel(coefs.ravel(), (0,) * len(coefs), (0,) * _lanes(width), (0,) * width)


def _lanes(width):
    """Reals in a row of `width` complex cells, rounded up to whole registers."""
    return 16 if width <= 8 else 32


def _stride(lengths):
    """Distance of rows in reals; rows of 2^k cells would share cache lines."""
    return 2 * (lengths[1] + 4)


def _pieces(n_points):
    """Number of pieces that the points are spread in."""
    return int(min(MOST_PIECES, max(1, n_points // PIECE_POINTS)))


def memory_size(n_points: int, starts: Sequence[int], counts: Sequence[int], eps: float, dtype: npt.DTypeLike) -> int:
    """Number of reals in the grid and the pieces, at most: these hold disjoint tiles of the rows, but for a halo each.

    Parameters
    ----------
    n_points : int
        Number of points M.
    starts, counts : (int, int)
        First sample and number of samples along both axes.
    eps : float
        Accuracy.
    dtype : float32 or float64
        Precision of the image.

    Returns
    -------
    int
    """
    width, _, lengths = _least_work(n_points, starts, counts, eps, dtype)
    height = lengths[0] + 2 * (width // 2 + 1)
    more = _pieces(n_points) - 1
    return (height + min(more, 1) * height + more * (width + TILE_ROWS)) * _stride(lengths)


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
            least = np.ceil(np.maximum(sigma * extents, (4 * (width // 2 + 1), margin))).astype(int)
            lengths = tuple(2 * scipy.fft.next_fast_len(int(n + 1) // 2) for n in least)
            points = n_points * (4 + 2.5 * width * _lanes(width) / 16)
            plans.append((points + 0.5 * np.prod(lengths) * np.log2(np.prod(lengths)), width, sigma, lengths))
    if not plans:
        raise ValueError(f"eps={eps} is too small to be reached in {np.dtype(dtype)}")
    return min(plans)[1:]


def _fft_lines(view, transform, worker, workers):
    """Unscaled FFT of a share of the lines, in place; SciPy's own threads take longer to wake."""
    lines = view[len(view) * worker // workers : len(view) * (worker + 1) // workers]
    result = transform(lines, norm="forward" if transform is scipy.fft.ifft else "backward", overwrite_x=True)
    if not np.may_share_memory(result, lines):
        lines[...] = result


_jit = jit.kernel()


@_jit
def _clear(memory, worker, workers):
    memory[memory.size * worker // workers : memory.size * (worker + 1) // workers] = 0


@_jit
def _interpolate(cells, stride, points, kernel, values, worker, workers):
    """values[point] = scales · Σ_rows kernel_0 Σ_columns kernel_1 · cells."""
    for p in range(points.order.size * worker // workers, points.order.size * (worker + 1) // workers):
        down = polynomials(kernel.coefs, points.within[p, 0], points.within[p, 1], kernel.terms, kernel.lanes)
        along = second_half_twice(down)
        real, imag = pair_sums(gather_rows(cells, points.first[p], stride, down, kernel.width) * along)
        values[points.order[p], 0] = points.scales[p, 0] * real
        values[points.order[p], 1] = points.scales[p, 1] * imag


@_jit
def _spread(cells, stride, points, kernel, pieces, values, worker, workers):
    """Transpose of `_interpolate`, each share of the points into its piece; the first is the grid, which is clear."""
    for piece in range(worker, len(pieces), workers):
        offset = pieces[piece, 2]
        cells[pieces[piece, 0] * stride + offset : pieces[piece, 1] * stride + offset] = 0
        for p in range(points.shares[piece], points.shares[piece + 1]):
            q = points.order[p]
            down = polynomials(kernel.coefs, points.within[p, 0], points.within[p, 1], kernel.terms, kernel.lanes)
            row = scale_pairs(second_half_twice(down), points.scales[p, 0] * values[q, 0],
                              points.scales[p, 1] * values[q, 1])
            scatter_rows(cells, points.first[p] + offset, stride, down, row, kernel.width)


@_jit
def _add_pieces(memory, stride, pieces, height, worker, workers):
    """Add the pieces to the grid, each worker some rows."""
    low, high = height * worker // workers, height * (worker + 1) // workers
    for piece in range(1, len(pieces)):
        for cell in range(max(low, pieces[piece, 0]) * stride, min(high, pieces[piece, 1]) * stride):
            memory[cell] += memory[cell + pieces[piece, 2]]
