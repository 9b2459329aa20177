"""Compiled kernels of the SARA dictionary: periodic 2-D wavelet transforms, a few lines at a time.

Analysis along an axis of even length n, with the reversed filters lo and hi of F taps (PyWavelets' periodization):

    a[k] = Σ_t lo[t] x[(2k + s + t) mod n],   d[k] = Σ_t hi[t] x[(2k + s + t) mod n],   s = 1 − F/2;

synthesis is its transpose.  One level of the analysis filters F + 2 input lines to two lines of a and two of d, split
into even and odd pixels, then these along themselves; each line of the four bands goes to its place, or into the dual
update, while it is in the L1 cache.  Synthesis runs the other way.

Levels 2, 3, … of a basis are small: one thread does them.  Level 1 is cut into chunks of lines: the bases share a
chunk of the image when analysing, and add to a chunk of the image in a fixed order when synthesising.  So no two
threads write to the same place, and the result does not depend on their number.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable

from casa_sara.operators._simd import (
    MAX_TAPS, VECTOR_BYTES, evens, filter_bank, load, load_first, maximum, minimum, odds, splat, store, store_first,
    zip_high, zip_low,
)

KEEP, CLIP, CLIP_WEIGHTED, REWEIGHT = range(4)
CHUNK = 16  # lines of level 1 done in one go
MARGIN = MAX_TAPS // 2 - 1  # image lines needed before those of a chunk
HALO = 16  # columns before and after the values of a scratch line
WINDOW_ROWS = 2 * CHUNK + MAX_TAPS
SCRATCH_ROWS = 12
TABLE_SIZE = 2 * MAX_TAPS
SIMD_SOURCE = "20bb7519b248"  # digest of _simd.py: the cache of compiled code watches this file only

ZERO, ONE = np.int64(0), np.int64(1)  # literals would make Numba compile the callee for each

_jit = njit(error_model="numpy", fastmath={"contract"})
_entry = njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract"})


class Filters(NamedTuple):
    """Taps of the b bases, plain at [0]; at [1], for the lines of level 1, with the gain 1/√b folded in."""

    lengths: np.ndarray  # (b,) taps of each basis, 0 for Dirac
    analysis: np.ndarray  # (2, b, 2, MAX_TAPS): lo and hi, reversed
    synthesis: np.ndarray  # (2, b, 2, MAX_TAPS): even and odd pixels; taps of (a, d) interleaved
    gain: float


class Target(NamedTuple):
    """Coefficients, and what becomes of a fresh coefficient a there.

    KEEP: a;  CLIP: clip(old + a, ±param);  CLIP_WEIGHTED: clip(old + a, ±param·weight);
    REWEIGHT: param/(param + |a|).
    """

    coefs: np.ndarray  # (b, NX, NY)
    weights: np.ndarray  # (b, NX, NY), used by CLIP_WEIGHTED only
    params: np.ndarray  # (b, levels, 4), one per band
    mode: int


class Work(NamedTuple):
    """Workspaces; their lines have room at the end for the last vector to overrun."""

    approx: np.ndarray  # (b, …) approximations of all levels
    owner: np.ndarray  # (b,) worker that does the deeper levels of each basis
    window: np.ndarray  # (workers, WINDOW_ROWS, …) lines of the image
    scratch: np.ndarray  # (workers, SCRATCH_ROWS, …)
    tables: np.ndarray  # (workers, 2, TABLE_SIZE) addresses of lines


@register_jitable
def _late(length):
    """Lag of the odd pixels of a synthesis behind the even ones, in lines; a step is two lines, a and d."""
    return 2 if length % 4 == 0 else 0


def _two_pairs(length):
    return 0, _late(length), 2, 2 + _late(length)


_analyse_lines = filter_bank(lambda length: (0, 0, 2, 2))
_analyse_along = filter_bank(lambda length: (0, 0), along=True)
_synthesise_lines = filter_bank(_two_pairs)
_synthesise_last_lines = filter_bank(_two_pairs, masked=True)
_synthesise_along = filter_bank(lambda length: (0, _late(length)), along=True)


@_jit
def padded_width(n, size):
    """Values to reserve for a line of n: whole quadruples of vectors, and one vector against cache conflicts."""
    width = VECTOR_BYTES // size
    return (-(-n // (4 * width)) * 4 + 1) * width


@_jit
def _approx(work, target, b, level):
    """Approximation of basis `b` at `level` ≥ 1, with padded lines; the deepest one is in the coefficients."""
    nx, ny = target.coefs.shape[1:]
    if level == target.params.shape[1]:
        return target.coefs[b]
    size, begin = work.approx.itemsize, 0
    for finer in range(1, level):
        begin += (nx >> finer) * padded_width(ny >> finer, size)
    width = padded_width(ny >> level, size)
    return work.approx[b, begin:begin + (nx >> level) * width].reshape(nx >> level, width)


@_jit
def _address(array, i):
    """Address of line `i` of a contiguous 2-D array."""
    return array.ctypes.data + i * array.shape[1] * array.itemsize


@_jit
def _tabulate(table, every, base, step, first, period, count):
    """Addresses of lines first, first + 1, … (mod period) to each `every`-th entry of the table."""
    i = first % period
    for p in range(count):
        table[every * p] = base + i * step
        i += 1
        if i == period:
            i = 0


@_jit
def _wrap(scratch, n):
    """Continue the first eight scratch lines, n values from column HALO, periodically."""
    for line in range(8):
        for i in range(1, MAX_TAPS // 4 + 1):
            scratch[line, HALO - i] = scratch[line, HALO + n - i]
        for i in range(MAX_TAPS // 4 + 1):
            scratch[line, HALO + n + i] = scratch[line, HALO + i]


@_jit
def _combine(old, fresh, weight, param, mode):
    """New value of a coefficient, see `Target`."""
    zero = param - param
    if mode == KEEP:
        return fresh
    if mode == REWEIGHT:
        return param / (param + maximum(fresh, zero - fresh))
    limit = param * weight if mode == CLIP_WEIGHTED else param
    return minimum(maximum(old + fresh, zero - limit), limit)


@_jit
def _deliver(fresh, n, coefs, weights, params, band, mode):
    """Combine n fresh coefficients at address `fresh` into those at `coefs`."""
    param = splat(params[band])
    end = coefs + n * params.itemsize
    while coefs + VECTOR_BYTES <= end:
        store(coefs, _combine(load(coefs, param), load(fresh, param), load(weights, param), param, mode))
        coefs += VECTOR_BYTES
        weights += VECTOR_BYTES
        fresh += VECTOR_BYTES
    if coefs < end:
        lanes = (end - coefs) // params.itemsize
        old, weight = load_first(coefs, lanes, param), load_first(weights, lanes, param)
        store_first(coefs, _combine(old, load(fresh, param), weight, param, mode), lanes)


@_jit
def _analyse_pair(table, n, taps, length, to, line):
    """Two lines of a and of d of the lines in `table`, split into even and odd pixels, to eight scratch lines."""
    for k in range(0, 2 * n * taps.itemsize, 2 * VECTOR_BYTES):
        v = _analyse_lines(table, (k, k + VECTOR_BYTES), taps, length, 0)
        for o in range(4):
            at = to + k // 2 + 2 * o * line
            store(at, evens(v[o], v[o + 4]))
            store(at + line, odds(v[o], v[o + 4]))


@_jit
def _analyse_line(pixels, n, taps, length, shift, to, low, line):
    """Filter an a and a d line along themselves: aa to `low`; ad, da, dd to three scratch lines from `to`."""
    for k in range(0, n * taps.itemsize, 2 * VECTOR_BYTES):
        a, d = shift + k, shift + k + 2 * line
        v = _analyse_along(pixels, (a, a + VECTOR_BYTES, d, d + VECTOR_BYTES), taps, length, 0)
        for i in range(2):
            at = k + i * VECTOR_BYTES
            store(low + at, v[2 * i])
            store(to + at, v[2 * i + 1])
            store(to + line + at, v[2 * i + 4])
            store(to + 2 * line + at, v[2 * i + 5])


@_jit
def _analyse(source, origin, b, level, begin, end, filters, target, work, worker):
    """Lines [begin, end) of the four bands of one level; the first line of `source` is line `origin` of that image."""
    length, size = filters.lengths[b], source.itemsize
    start = 1 - length // 2
    nx, ny = target.coefs.shape[1] >> level, target.coefs.shape[2] >> level
    line_taps, taps = filters.analysis[1 if level == 1 else 0, b], filters.analysis[0, b]
    low, deepest = _approx(work, target, b, level), level == target.params.shape[1]
    plane, weights, step = target.coefs[b], target.weights[b], target.coefs.shape[2] * size
    params, mode = target.params[b, level - 1], target.mode
    scratch, table = work.scratch[worker], work.tables[worker, 0]
    line = scratch.shape[1] * size
    phases, fresh = _address(scratch, ZERO) + HALO * size, _address(scratch, ZERO) + 8 * line
    first = phases + (start + 1) // 2 * size
    pixels = (first + line - size, first) if start % 2 else (first, first + line)  # a filter begins on an odd pixel
    for r in range(begin, end, 2):
        _tabulate(table, 1, _address(source, ZERO), source.shape[1] * size, 2 * r + start - origin, source.shape[0],
                  length + 2)
        _analyse_pair(table, ny, line_taps, length, phases, line)
        _wrap(scratch, ny)
        for i in range(r, min(r + 2, end)):
            aa = fresh if deepest else _address(low, i)
            _analyse_line(pixels, ny, taps, length, 4 * (i - r) * line, fresh + line, aa, line)
            for band in range(0 if deepest else 1, 4):
                there = band // 2 * nx * step + band % 2 * ny * size
                _deliver(fresh + band * line, ny, _address(plane, i) + there, _address(weights, i) + there, params,
                         band, mode)


@_jit
def _store_lines(at, line, v, i):
    for o in range(4):
        store(at + 2 * o * line, v[4 * i + o])


@_jit
def _synthesise_quad(table, n, taps, length, to, line):
    """Four image lines, in one half of the columns, of the lines in `table` to every other scratch line."""
    size, width = taps.itemsize, 2 * VECTOR_BYTES
    whole = n * size // width * width
    for k in range(0, whole, width):
        v = _synthesise_lines(table, (k, k + VECTOR_BYTES), taps, length, 0)
        _store_lines(to + k, line, v, 0)
        _store_lines(to + k + VECTOR_BYTES, line, v, 1)
    for k in range(whole, n * size, VECTOR_BYTES):
        v = _synthesise_last_lines(table, (k,), taps, length, n - k // size)
        _store_lines(to + k, line, v, 0)


@_jit
def _put_pixels(at, even, odd, add):
    low, high = zip_low(even, odd), zip_high(even, odd)
    if add:
        low, high = low + load(at, low), high + load(at + VECTOR_BYTES, high)
    store(at, low)
    store(at + VECTOR_BYTES, high)


@_jit
def _synthesise_pair(halves, n, taps, length, shift, line, to, step, add):
    """Two image lines, of their a and d halves in scratch, to `to` or added to what is there."""
    for k in range(0, n * taps.itemsize, 2 * VECTOR_BYTES):
        one, two = shift + k, shift + k + 2 * line
        v = _synthesise_along(halves, (one, one + VECTOR_BYTES, two, two + VECTOR_BYTES), taps, length, 0)
        for i in range(2):
            at = to + 2 * k + 2 * i * VECTOR_BYTES
            _put_pixels(at, v[2 * i], v[2 * i + 1], add)
            _put_pixels(at + step, v[2 * i + 4], v[2 * i + 5], add)


@_jit
def _synthesise(out, origin, b, level, begin, end, filters, target, work, worker):
    """Image lines [2 begin, 2 end) of one level to `out`, whose first is line `origin`; at level 1 added to it."""
    length, size = filters.lengths[b], out.itemsize
    start = 1 - length // 2
    first = start - (start + 1) // 2  # pixels 2j and 2j + 1 need lines j + first, j + first + 1, …
    steps = (length + _late(length)) // 2
    nx, ny = target.coefs.shape[1] >> level, target.coefs.shape[2] >> level
    line_taps, taps = filters.synthesis[1 if level == 1 else 0, b], filters.synthesis[0, b]
    low, coefs, step = _approx(work, target, b, level), _address(target.coefs[b], ZERO), target.coefs.shape[2] * size
    scratch, left, right = work.scratch[worker], work.tables[worker, 0], work.tables[worker, 1]
    line = scratch.shape[1] * size
    parts = _address(scratch, ZERO) + HALO * size
    halves = (parts + first * size, parts + line + first * size)
    for j in range(begin, end, 2):
        _tabulate(left, 2, _address(low, ZERO), low.shape[1] * size, j + first, nx, steps + 1)
        _tabulate(left[1:], 2, coefs + nx * step, step, j + first, nx, steps + 1)
        _tabulate(right, 2, coefs + ny * size, step, j + first, nx, steps + 1)
        _tabulate(right[1:], 2, coefs + nx * step + ny * size, step, j + first, nx, steps + 1)
        _synthesise_quad(left, ny, line_taps, length, parts, line)
        _synthesise_quad(right, ny, line_taps, length, parts + line, line)
        _wrap(scratch, ny)
        for i in range(j, min(j + 2, end)):
            _synthesise_pair(halves, ny, taps, length, 4 * (i - j) * line, line, _address(out, 2 * i - origin),
                             out.shape[1] * size, level == 1)


@_jit
def _share(n, worker, workers):
    """Range of the n things that are this worker's."""
    return n * worker // workers, n * (worker + 1) // workers


@_entry
def analyse_finest(image, filters, target, work, worker, workers):
    """Level 1 and Dirac: this worker's share of the lines of all bases."""
    nx, ny = target.coefs.shape[1:]
    window, spare = work.window[worker], work.scratch[worker, 0]
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
                _analyse(window, origin, b, ONE, begin, end, filters, target, work, worker)
                continue
            for i in range(2 * begin, 2 * end):
                for k in range(ny):
                    spare[k] = filters.gain * window[i - origin, k]
                _deliver(_address(work.scratch[worker], ZERO), ny, _address(target.coefs[b], i), _address(target.weights[b], i),
                         target.params[b, 0], ZERO, target.mode)


@_entry
def transform_deeper(filters, target, work, forth, back, worker, workers):
    """Levels 2, 3, … of the bases this worker owns: analysis if `forth`, synthesis if `back`."""
    levels = target.params.shape[1]
    for b in range(filters.lengths.size):
        if work.owner[b] != worker or filters.lengths[b] == 0:
            continue
        for level in range(2, levels + 1 if forth else 2):
            source = _approx(work, target, b, level - 1)
            _analyse(source, ZERO, b, level, ZERO, source.shape[0] // 2, filters, target, work, worker)
        for level in range(levels if back else 1, 1, -1):
            out = _approx(work, target, b, level - 1)
            _synthesise(out, ZERO, b, level, ZERO, out.shape[0] // 2, filters, target, work, worker)


@_entry
def synthesise_finest(out, filters, target, work, worker, workers):
    """Level 1 and Dirac: this worker's share of the lines of the image."""
    nx, ny = target.coefs.shape[1:]
    window = work.window[worker]
    first, last = _share(nx // 2, worker, workers)
    for begin in range(first, last, CHUNK):
        end = min(begin + CHUNK, last)
        window[:2 * (end - begin)] = 0
        for b in range(filters.lengths.size):
            if filters.lengths[b]:
                _synthesise(window, 2 * begin, b, ONE, begin, end, filters, target, work, worker)
                continue
            for i in range(2 * begin, 2 * end):
                for k in range(ny):
                    window[i - 2 * begin, k] += filters.gain * target.coefs[b, i, k]
        for i in range(2 * begin, min(2 * end, out.shape[0])):
            for k in range(out.shape[1]):
                out[i, k] = window[i - 2 * begin, k]
