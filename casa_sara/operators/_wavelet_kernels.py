"""Compiled stages of the SARA dictionary: what one of several threads does of a transform of all bases.

Levels 2, 3, … of a basis are small: one thread does them.  Level 1 is cut into chunks of lines: the bases share a
chunk of the image when analysing, and add to a chunk of the image in a fixed order when synthesising.  So no two
threads write to the same place, and the result does not depend on their number.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from casa_sara.operators._filter_bank import MAX_TAPS
from casa_sara.operators._vectors import VECTOR_BYTES
from casa_sara.operators._wavelet_lines import (
    HALO,
    Place,
    analyse_along,
    analyse_lines,
    compiled,
    late,
    synthesise_along,
    synthesise_lines,
    tabulate,
    update_pixels,
    wrap,
)
from casa_sara.runtime import jit

CHUNK = 16  # lines of level 1 done in one go
MARGIN = MAX_TAPS // 2 - 1  # image lines needed before those of a chunk
WINDOW_ROWS = 2 * CHUNK + MAX_TAPS
ANALYSE_FINEST, ANALYSE_DEEPER, SYNTHESISE_DEEPER, BOTH_DEEPER, SYNTHESISE_FINEST = range(5)  # stages
ZERO, ONE = np.int64(0), np.int64(1)  # literals would make Numba compile the callee for each
# digest of _vectors, _filter_bank and _wavelet_lines: the cache of compiled code watches this file only
SOURCE = "367a868c6c75"

_inlined = jit.inner(error_model="numpy", fastmath={"contract"}, inline="always")


class Filters(NamedTuple):
    """Taps of the b bases, plain at [0]; at [1], for the lines of level 1, with the gain 1/√b folded in."""

    lengths: np.ndarray  # (b,) taps of each basis, 0 for Dirac
    analysis: np.ndarray  # (2, b, 2, MAX_TAPS): lo and hi, reversed
    synthesis: np.ndarray  # (2, b, 2, MAX_TAPS): even and odd pixels; taps of (a, d) interleaved
    gain: float


class Target(NamedTuple):
    """Coefficients, and what becomes of a fresh one there: a mode of `_wavelet_lines` and its parameters."""

    coefs: np.ndarray  # (b, NX, NY)
    weights: np.ndarray  # (b, NX, NY), of meaning to CLIP_WEIGHTED only
    params: np.ndarray  # (b, 2): threshold κ and relaxation ρ of each basis
    mode: int


class Work(NamedTuple):
    """Workspaces; their lines have room at the end for the last vector to overrun."""

    levels: int
    approx: np.ndarray  # (b, …) approximations of all levels
    owner: np.ndarray  # (b,) worker that does the deeper levels of each basis
    window: np.ndarray  # (workers, WINDOW_ROWS, …) lines of the image
    scratch: np.ndarray  # (workers, SCRATCH_ROWS, …)
    tables: np.ndarray  # (workers, 2, TABLE_SIZE) addresses of lines


class Job(NamedTuple):
    """All that a stage works with."""

    filters: Filters
    target: Target
    work: Work


@register_jitable  # compiled within kernels; called from Python as it is, which does not wait for a compiler
def padded_width(n, size):
    """Values to reserve for a line of n: whole quadruples of vectors, and one vector against cache conflicts."""
    width = VECTOR_BYTES // size
    return (-(-n // (4 * width)) * 4 + 1) * width


@compiled
def _approx(job, b, level):
    """Approximation of basis `b` at `level` ≥ 1, with padded lines; the deepest one is in the coefficients."""
    nx, ny = job.target.coefs.shape[1:]
    if level == job.work.levels:
        return job.target.coefs[b]
    size, begin = job.work.approx.itemsize, 0
    for finer in range(1, level):
        begin += (nx >> finer) * padded_width(ny >> finer, size)
    width = padded_width(ny >> level, size)
    return job.work.approx[b, begin:begin + (nx >> level) * width].reshape(nx >> level, width)


@compiled
def _address(array, i):
    """Address of line `i` of a contiguous 2-D array."""
    return array.ctypes.data + i * array.shape[1] * array.itemsize


@compiled
def _analyse(source, origin, b, level, begin, end, job, worker):
    """Lines [begin, end) of the four bands of one level; the first line of `source` is line `origin` of that image.

    Two lines r, r + 1 of each band at a time, by way of eight scratch lines; a filter begins at pixel s = `start`::

        source                         scratch                        coefs[b] (aa in `approx` but at the deepest level)
        line 2r + s          ─┐        0  a[r] even pixels  ─┐                 ◀─ right ─▶
             2r + s + 1       │ across 1  a[r] odd pixels    │ along  ┌───────────┬───────────┐
               ⋮              ├──────▶ 2  d[r] even pixels   ├──────▶ │ aa, line r│ ad, line r│ ▲
             2r + s + F + 1  ─┘ lines  3  d[r] odd pixels   ─┘        ├───────────┼───────────┤ down
        (`table` has their             4 … 7  the same of r + 1       │ da, line r│ dd, line r│ ▼
        addresses, periodic)                                          └───────────┴───────────┘

    The pixels of a scratch line begin at its value HALO: :func:`wrap` continues them periodically to both sides.
    """
    filters, target, work = job
    length, size = filters.lengths[b], source.itemsize
    start = 1 - length // 2
    coefs, weights, step = target.coefs[b], target.weights[b], target.coefs.shape[2] * size
    right, down = (target.coefs.shape[2] >> level) * size, (target.coefs.shape[1] >> level) * step
    line_taps, taps = filters.analysis[1 if level == 1 else 0, b], filters.analysis[0, b]
    approx, deepest = _approx(job, b, level), level == work.levels
    scratch, table = work.scratch[worker], work.tables[worker, 0]
    line = scratch.shape[1] * size
    phases = _address(scratch, ZERO) + HALO * size
    first = phases + (start + 1) // 2 * size
    pixels = (first + line - size, first) if start % 2 else (first, first + line)  # a filter begins on an odd pixel
    for r in range(begin, end, 2):
        tabulate(table, 1, _address(source, ZERO), source.shape[1] * size, 2 * r + start - origin, source.shape[0],
                 length + 2)
        place = Place(_address(coefs, r), _address(weights, r), right, down)
        analyse_lines(table, line_taps, length, phases, line, place, step)
        wrap(scratch, right // size)
        for i in range(r, min(r + 2, end)):
            place = Place(_address(coefs, i), _address(weights, i), right, down)
            low = 0 if deepest else _address(approx, i)
            analyse_along(pixels, taps, length, 4 * (i - r) * line, line, low, place, target.params[b],
                          target.mode)


@compiled
def _synthesise(out, origin, b, level, begin, end, job, worker):
    """Image lines [2 begin, 2 end) of one level to `out`, whose first is line `origin`; at level 1 added to it."""
    filters, target, work = job
    length, size = filters.lengths[b], out.itemsize
    start = 1 - length // 2
    first = start - (start + 1) // 2  # pixels 2j and 2j + 1 need lines j + first, j + first + 1, …
    steps = (length + late(length)) // 2
    nx, ny = target.coefs.shape[1] >> level, target.coefs.shape[2] >> level
    line_taps, taps = filters.synthesis[1 if level == 1 else 0, b], filters.synthesis[0, b]
    low, coefs, step = _approx(job, b, level), _address(target.coefs[b], ZERO), target.coefs.shape[2] * size
    scratch, left, right = work.scratch[worker], work.tables[worker, 0], work.tables[worker, 1]
    line = scratch.shape[1] * size
    parts = _address(scratch, ZERO) + HALO * size
    halves = (parts + first * size, parts + line + first * size)
    for j in range(begin, end, 2):
        tabulate(left, 2, _address(low, ZERO), low.shape[1] * size, j + first, nx, steps + 1)
        tabulate(left[1:], 2, coefs + nx * step, step, j + first, nx, steps + 1)
        tabulate(right, 2, coefs + ny * size, step, j + first, nx, steps + 1)
        tabulate(right[1:], 2, coefs + nx * step + ny * size, step, j + first, nx, steps + 1)
        synthesise_lines(left, ny, line_taps, length, parts, line)
        synthesise_lines(right, ny, line_taps, length, parts + line, line)
        wrap(scratch, ny)
        for i in range(j, min(j + 2, end)):
            synthesise_along(halves, ny, taps, length, 4 * (i - j) * line, line, _address(out, 2 * i - origin),
                             out.shape[1] * size, level == 1)


@compiled
def _share(n, worker, workers):
    """Range of the n things that are this worker's."""
    return n * worker // workers, n * (worker + 1) // workers


@_inlined
def _analyse_finest(image, job, worker, workers):
    """Level 1 and Dirac: this worker's share of the lines of all bases."""
    filters, target, work = job
    nx, ny = target.coefs.shape[1:]
    window = work.window[worker]
    first, last = _share(nx // 2, worker, workers)
    for begin in range(first, last, CHUNK):
        end = min(begin + CHUNK, last)
        origin = 2 * begin - MARGIN
        for row in range(2 * (end - begin) + MAX_TAPS):
            i = (origin + row) % nx
            filled = image.shape[1] if i < image.shape[0] else 0
            for k in range(filled):
                window[row, k] = image[i, k]
            window[row, filled:] = 0
        for b in range(filters.lengths.size):
            if filters.lengths[b]:
                _analyse(window, origin, b, ONE, begin, end, job, worker)
                continue
            for i in range(2 * begin, 2 * end):
                place = Place(_address(target.coefs[b], i), _address(target.weights[b], i), ny * window.itemsize, ZERO)
                update_pixels(_address(window, i - origin), place, filters.gain, target.params[b], target.mode)


@_inlined
def _transform_deeper(job, forth, back, worker, workers):
    """Levels 2, 3, … of the bases this worker owns: analysis if `forth`, synthesis if `back`."""
    levels = job.work.levels
    for b in range(job.filters.lengths.size):
        if job.work.owner[b] != worker or job.filters.lengths[b] == 0:
            continue
        for level in range(2, levels + 1 if forth else 2):
            source = _approx(job, b, level - 1)
            _analyse(source, ZERO, b, level, ZERO, source.shape[0] // 2, job, worker)
        for level in range(levels if back else 1, 1, -1):
            out = _approx(job, b, level - 1)
            _synthesise(out, ZERO, b, level, ZERO, out.shape[0] // 2, job, worker)


@_inlined
def _synthesise_finest(out, job, worker, workers):
    """Level 1 and Dirac: this worker's share of the lines of the image."""
    filters, target, work = job
    nx, ny = target.coefs.shape[1:]
    window = work.window[worker]
    first, last = _share(nx // 2, worker, workers)
    for begin in range(first, last, CHUNK):
        end = min(begin + CHUNK, last)
        window[:2 * (end - begin)] = 0
        for b in range(filters.lengths.size):
            if filters.lengths[b]:
                _synthesise(window, 2 * begin, b, ONE, begin, end, job, worker)
                continue
            for i in range(2 * begin, 2 * end):
                for k in range(ny):
                    window[i - 2 * begin, k] += filters.gain * target.coefs[b, i, k]
        for i in range(2 * begin, min(2 * end, out.shape[0])):
            for k in range(out.shape[1]):
                out[i, k] = window[i - 2 * begin, k]


@jit.kernel(error_model="numpy", fastmath={"contract"})
def transform(stage, image, job, worker, workers):
    """What one worker does of a stage: from the image, within the coefficients, or to the image.

    One kernel for all stages: the two filters, which they share, take most of the time to compile.
    """
    if stage == ANALYSE_FINEST:
        _analyse_finest(image, job, worker, workers)
    elif stage == SYNTHESISE_FINEST:
        _synthesise_finest(image, job, worker, workers)
    else:
        _transform_deeper(job, stage != SYNTHESISE_DEEPER, stage != ANALYSE_DEEPER, worker, workers)
