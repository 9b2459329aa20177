"""The compiled kernels of `decimation.py`: images to samples of their band, and back."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from casa_sara.operators._vectors import load_at, multiply_add, store_at, zeros
from casa_sara.runtime import jit

__all__ = ["GROUP", "Separable", "decimate", "expand", "expand_rows", "scratch_shape"]

WIDE, SINGLE = (0,) * 32, (0,)  # lengths of vectors
GROUP = 4  # rows that are summed together


class Separable(NamedTuple):
    """One axis as the compiled kernels take it."""

    taps: np.ndarray  # complex (W + 2·margin,), zeros in the margins
    margin: int
    factor: int
    first: int  # pixel under the first tap of the first sample, ≤ 0
    cells: np.ndarray  # int64 (count,), where each sample goes in the grid
    gains: np.ndarray  # complex (count,), what it is multiplied with


def scratch_shape(columns: Separable, workers: int) -> tuple[int, ...]:
    """Shape of the real work space of `decimate` and `expand`.

    Parameters
    ----------
    columns : Separable
        Taps, cells and gains along the second axis.
    workers : int
        Number of threads that share the work.

    Returns
    -------
    tuple of int
    """
    shifts = -(-(columns.taps.size - 2 * columns.margin) // columns.factor)
    vectors = -(-(columns.cells.size + shifts) // len(WIDE))
    return workers, columns.factor + 2, shifts + vectors * len(WIDE)


_jit = jit.kernel()
_inlined = jit.inner(inline="always")  # one function to compile instead of seven


@_jit
def decimate(image, rows, columns, grid, lines, scratch, worker, workers):
    """Write the samples of a real image (nx, ny) into a complex grid, times their gains.

    `lines` real (rows.cells.size, ny) receives the image decimated along its first axis only, by
    real taps.  `scratch` has the shape `scratch_shape`.

    Parameters
    ----------
    image : real (nx, ny)
        The image.
    rows : Separable
        Taps, cells and gains along the first axis.
    columns : Separable
        Taps, cells and gains along the second axis.
    grid : complex (NX, NY)
        The samples of the image on the grid of the transform.
    lines : real (rows.cells.size, ny)
        The image decimated along its first axis only.
    scratch : real
        Work space of the shape `scratch_shape`.
    worker : int
        Number of this thread among them.
    workers : int
        Number of threads that share the work.
    """
    n_taps = rows.taps.size - 2 * rows.margin
    begin, end = rows.cells.size * worker // workers, rows.cells.size * (worker + 1) // workers
    phases, sums = scratch[worker, :-2], scratch[worker, -2:]
    for group in range(begin, end, GROUP):
        top = rows.first + rows.factor * group
        low, high = max(0, -top), min(n_taps + rows.margin, image.shape[0] - top)
        size = min(GROUP, end - group)
        tap, pixels = rows.margin + low, image[top + low : top + high]
        _weigh_rows(lines[group : group + size], pixels, rows.taps, tap, np.int64(1), -rows.factor)
        for i in range(group, group + size):
            _split_phases(lines[i], columns, phases)
            _filter_phases(phases, columns, sums)
            for j in range(columns.cells.size):
                gain = rows.gains[i] * columns.gains[j]
                grid[rows.cells[i], columns.cells[j]] = complex(sums[0, j], sums[1, j]) * gain


@_jit
def expand(grid, rows, columns, lines, scratch, worker, workers):
    """Transpose of the second half of `decimate`: samples in the grid to `lines`, Re of the conjugate.

    Parameters
    ----------
    grid : complex (NX, NY)
        The samples of the image on the grid of the transform.
    rows : Separable
        Taps, cells and gains along the first axis.
    columns : Separable
        Taps, cells and gains along the second axis.
    lines : real (rows.cells.size, ny)
        The image decimated along its first axis only.
    scratch : real
        Work space of the shape `scratch_shape`.
    worker : int
        Number of this thread among them.
    workers : int
        Number of threads that share the work.
    """
    phases, sums = scratch[worker, :-2], scratch[worker, -2:]
    shifts = -(-(columns.taps.size - 2 * columns.margin) // columns.factor)
    for i in range(rows.cells.size * worker // workers, rows.cells.size * (worker + 1) // workers):
        sums[:] = 0
        for j in range(columns.cells.size):
            value = grid[rows.cells[i], columns.cells[j]] * np.conj(rows.gains[i] * columns.gains[j])
            sums[0, shifts + j], sums[1, shifts + j] = value.real, value.imag
        _spread_phases(sums, columns, phases, shifts)
        _join_phases(phases, columns, lines[i])


@_jit
def expand_rows(lines, rows, image, worker, workers):
    """Transpose of the first half of `decimate`: lines to a real image (nx, ny).

    Parameters
    ----------
    lines : real (rows.cells.size, ny)
        The image decimated along its first axis only.
    rows : Separable
        Taps, cells and gains along the first axis.
    image : real (nx, ny)
        The image.
    worker : int
        Number of this thread among them.
    workers : int
        Number of threads that share the work.
    """
    n_taps = rows.taps.size - 2 * rows.margin
    begin, end = image.shape[0] * worker // workers, image.shape[0] * (worker + 1) // workers
    for group in range(begin, end, GROUP):
        size, offset = min(GROUP, end - group), group - rows.first
        low = max(0, -((n_taps - 1 - offset) // rows.factor))
        high = min(rows.cells.size, (offset + size - 1) // rows.factor + 1)
        tap = rows.margin + offset - rows.factor * low
        _weigh_rows(image[group : group + size], lines[low:high], rows.taps, tap, -rows.factor, np.int64(1))


@_inlined
def _weigh_rows(out, rows, taps, first, row_step, out_step):
    """out[r] = Σ_t taps[first + t·row_step + r·out_step].real · rows[t], for at most GROUP rows r."""
    length = out.shape[1]
    if length < len(WIDE):
        for j in range(length):
            _weigh_block(out, rows.reshape(-1), j, taps, first, row_step, out_step, SINGLE)
    else:
        for block in range(0, length, len(WIDE)):
            _weigh_block(out, rows.reshape(-1), min(block, length - len(WIDE)), taps, first, row_step, out_step, WIDE)


@_inlined
def _weigh_block(out, rows, column, taps, first, row_step, out_step, lanes):
    """len(lanes) columns of `_weigh_rows`, in registers."""
    length, pixels = out.shape[1], out.reshape(-1)
    sum0 = sum1 = sum2 = sum3 = zeros(rows, lanes)
    tap = first
    for t in range(rows.size // length):
        row = load_at(rows, t * length + column, lanes)
        sum0 = multiply_add(row, taps[tap].real, sum0)
        sum1 = multiply_add(row, taps[tap + out_step].real, sum1)
        sum2 = multiply_add(row, taps[tap + 2 * out_step].real, sum2)
        sum3 = multiply_add(row, taps[tap + 3 * out_step].real, sum3)
        tap += row_step
    for r in range(len(out)):
        store_at(pixels, r * length + column, sum0)
        sum0, sum1, sum2 = sum1, sum2, sum3


@_inlined
def _split_phases(line, columns, phases):
    """phases[q, k] = line[first + factor·k + q], zero beyond the borders."""
    phases[:] = 0
    for q in range(columns.factor):
        low = -((columns.first + q) // columns.factor)
        for k in range(low, -(-(line.size - columns.first - q) // columns.factor)):
            phases[q, k] = line[columns.first + columns.factor * k + q]


@_inlined
def _join_phases(phases, columns, line):
    """Transpose of `_split_phases`."""
    for q in range(columns.factor):
        low = -((columns.first + q) // columns.factor)
        for k in range(low, -(-(line.size - columns.first - q) // columns.factor)):
            line[columns.first + columns.factor * k + q] = phases[q, k]


@_inlined
def _filter_phases(phases, columns, sums):
    """sums[:, j] = (Re, Im) of Σ_t taps[t] · line[first + factor·j + t]."""
    flat, width, both = phases.reshape(-1), phases.shape[1], sums.reshape(-1)
    n_taps = columns.taps.size - 2 * columns.margin
    for j in range(0, columns.cells.size, len(WIDE)):
        real = imag = zeros(flat, WIDE)
        for q in range(columns.factor):
            for a in range(-(-(n_taps - q) // columns.factor)):
                tap = columns.taps[columns.margin + columns.factor * a + q]
                pixels = load_at(flat, q * width + a + j, WIDE)
                real, imag = multiply_add(pixels, tap.real, real), multiply_add(pixels, tap.imag, imag)
        store_at(both, j, real)
        store_at(both, width + j, imag)


@_inlined
def _spread_phases(sums, columns, phases, shifts):
    """Transpose of `_filter_phases`, from sums[:, shifts + j]; zeros surround them."""
    flat, width, both = phases.reshape(-1), phases.shape[1], sums.reshape(-1)
    n_taps = columns.taps.size - 2 * columns.margin
    for q in range(columns.factor):
        for k in range(0, width - shifts, len(WIDE)):
            total = zeros(flat, WIDE)
            for a in range(-(-(n_taps - q) // columns.factor)):
                tap = columns.taps[columns.margin + columns.factor * a + q]
                total = multiply_add(load_at(both, shifts + k - a, WIDE), tap.real, total)
                total = multiply_add(load_at(both, width + shifts + k - a, WIDE), tap.imag, total)
            store_at(flat, q * width + k, total)
