"""Compiled kernels of the SARA dictionary: periodic 2-D wavelet transforms, a few lines at a time.

Analysis along an axis of even length n, with the reversed filters lo and hi of F taps (PyWavelets' periodization):

    a[k] = Σ_t lo[t] x[(2k + s + t) mod n],   d[k] = Σ_t hi[t] x[(2k + s + t) mod n],   s = 1 − F/2;

synthesis is its transpose.  One level of the analysis takes F + 2 input lines, forms two lines of a and two of d
(split into even and odd pixels, in the L1 cache) and filters these along themselves; every line of the four bands
goes to its place, or into the dual update, while still in cache.  Synthesis runs the other way.

Levels 2, 3, … of a basis are small and stay in cache: one thread does them.  Level 1 is cut into chunks of lines: the
bases share the chunk of the image when analysing, and add to the same chunk of the image in turn when synthesising,
always in the same order.  So no two threads write to the same place and the result is independent of their number.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from casa_sara.operators._simd import (
    MAX_TAPS, VECTOR_BYTES, evens, filter_bank, load, load_first, maximum, minimum, odds, splat, store, store_first,
    zip_high, zip_low,
)

KEEP, CLIP, CLIP_WEIGHTED, REWEIGHT = range(4)
CHUNK = 8  # lines of level 1 done in one go
MARGIN = MAX_TAPS // 2 - 1  # lines of the image needed before those of a chunk
HALO = 64 // 4  # columns kept free before a scratch line
WINDOW_ROWS = 2 * CHUNK + MAX_TAPS
SCRATCH_ROWS = 12
TABLE_SIZE = 2 * MAX_TAPS

_jit = njit(error_model="numpy", fastmath={"contract"})
_entry = njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract"})


class Filters(NamedTuple):
    """Taps of all bases; the gain 1/√b is folded into the scaled ones, for the lines of level 1."""

    lengths: np.ndarray  # (b,) taps of each basis, 0 for Dirac
    analysis: np.ndarray  # (2, b, 2, MAX_TAPS): plain and scaled; lo and hi
    synthesis: np.ndarray  # (2, b, 2, MAX_TAPS): plain and scaled; even and odd pixels, (lo, hi) interleaved
    gain: float


class Target(NamedTuple):
    """Coefficients, and what becomes of a fresh coefficient a there.

    KEEP: a;  CLIP: clip(old + a, ±param);  CLIP_WEIGHTED: clip(old + a, ±param·weight);
    REWEIGHT: param/(param + |a|).
    """

    coefs: np.ndarray  # (b, NX, NY)
    weights: np.ndarray  # (b, NX, NY), read by CLIP_WEIGHTED only
    params: np.ndarray  # (b, levels, 4): one per band
    mode: int


class Work(NamedTuple):
    """Workspaces; lines have free room for a few vectors at their end."""

    approx: np.ndarray  # (b, …) approximations of all levels
    window: np.ndarray  # (threads, WINDOW_ROWS, …) lines of the image
    scratch: np.ndarray  # (threads, SCRATCH_ROWS, …)
    tables: np.ndarray  # (threads, 3, TABLE_SIZE) addresses of lines


def _late(length):
    """Lag in lines of the odd pixels behind the even ones in a synthesis; two lines, lo and hi, to a step."""
    return 2 if length % 4 == 0 else 0


_analyse_lines = filter_bank(lambda length: (0, 0, 2, 2))
_analyse_along = filter_bank(lambda length: (0, 0))
_synthesise_lines = filter_bank(lambda length: (0, _late(length), 2, 2 + _late(length)))
_synthesise_last_lines = filter_bank(lambda length: (0, _late(length), 2, 2 + _late(length)), masked=True)
_synthesise_along = filter_bank(lambda length: (0, _late(length)))


@_jit
def padded_width(n, size):
    """Values to reserve for a line of n: whole quadruples of vectors, and one vector against cache conflicts."""
    width = VECTOR_BYTES // size
    return (-(-n // (4 * width)) * 4 + 1) * width


@_jit
def _approx(work, shape, b, level):
    """Approximation of basis `b` at `level` ≥ 1 of an image of `shape`, with padded lines."""
    size = work.approx.itemsize
    begin, nx = 0, shape[0] >> 1
    for finer in range(1, level):
        begin += nx * padded_width(shape[1] >> finer, size)
        nx >>= 1
    width = padded_width(shape[1] >> level, size)
    return work.approx[b, begin:begin + nx * width].reshape(nx, width)


@_jit
def _address(array, i):
    return array.ctypes.data + i * array.shape[1] * array.itemsize


@_jit
def _tabulate(table, first_entry, stride, base, step, first, period, count):
    """Addresses of lines first, first + 1, … (mod period) to every `stride`-th entry of the table."""
    i = first % period
    for p in range(count):
        table[first_entry + stride * p] = base + i * step
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
def _deliver(fresh, n, coefs, weights, params, o, mode):
    """Combine n fresh coefficients at address `fresh` into those at `coefs`, with params[o]."""
    param = splat(params[o])
    end = coefs + n * params.itemsize
    while coefs + VECTOR_BYTES <= end:
        old, weight = load(coefs, param), load(weights, param)
        store(coefs, _combine(old, load(fresh, param), weight, param, mode))
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
        at = to + k // 2
        store(at, evens(v[0], v[4]))
        store(at + line, odds(v[0], v[4]))
        store(at + 2 * line, evens(v[1], v[5]))
        store(at + 3 * line, odds(v[1], v[5]))
        store(at + 4 * line, evens(v[2], v[6]))
        store(at + 5 * line, odds(v[2], v[6]))
        store(at + 6 * line, evens(v[3], v[7]))
        store(at + 7 * line, odds(v[3], v[7]))


@_jit
def _analyse_line(table, n, taps, length, shift, to, low, line):
    """Filter an a and a d line along themselves: aa to `low`, ad, da, dd to three scratch lines from `to`."""
    for k in range(0, n * taps.itemsize, 2 * VECTOR_BYTES):
        a, d = shift + k, shift + k + 2 * line
        v = _analyse_along(table, (a, a + VECTOR_BYTES, d, d + VECTOR_BYTES), taps, length, 0)
        store(low + k, v[0])
        store(low + k + VECTOR_BYTES, v[2])
        store(to + k, v[1])
        store(to + k + VECTOR_BYTES, v[3])
        store(to + line + k, v[4])
        store(to + line + k + VECTOR_BYTES, v[6])
        store(to + 2 * line + k, v[5])
        store(to + 2 * line + k + VECTOR_BYTES, v[7])


@_jit
def _analyse(source, origin, filters, target, work, worker, b, level, low, begin, end):
    """Lines [begin, end) of the bands of one level; the first line of `source` is line `origin` of that image.

    The approximation goes to `low`, at the deepest level to the target.
    """
    length = filters.lengths[b]
    start = 1 - length // 2
    nx, ny = target.coefs.shape[1] >> level, target.coefs.shape[2] >> level
    size = source.itemsize
    scratch, table, along = work.scratch[worker], work.tables[worker, 0], work.tables[worker, 1]
    line = scratch.shape[1] * size
    phases = _address(scratch, 0) + HALO * size
    fresh = _address(scratch, 8)
    first = phases + (start + 1) // 2 * size
    if start % 2:  # the filters begin on an odd pixel
        _tabulate(along, 0, 2, first + line - size, size, 0, length, length // 2)
        _tabulate(along, 1, 2, first, size, 0, length, length // 2)
    else:
        _tabulate(along, 0, 2, first, size, 0, length, length // 2)
        _tabulate(along, 1, 2, first + line, size, 0, length, length // 2)
    line_taps, taps = filters.analysis[1 if level == 1 else 0, b], filters.analysis[0, b]
    params = target.params[b, level - 1]
    step = target.coefs.shape[2] * size
    deepest = level == target.params.shape[1]
    for r in range(begin, end, 2):
        _tabulate(table, 0, 1, _address(source, 0), source.shape[1] * size, 2 * r + start - origin, source.shape[0],
                  length + 2)
        _analyse_pair(table, ny, line_taps, length, phases, line)
        _wrap(scratch, ny)
        for i in range(r, min(r + 2, end)):
            _analyse_line(along, ny, taps, length, 4 * (i - r) * line, fresh + line,
                          fresh if deepest else _address(low, i), line)
            coefs, weights = _address(target.coefs[b], i), _address(target.weights[b], i)
            if deepest:
                _deliver(fresh, ny, coefs, weights, params, 0, target.mode)
            _deliver(fresh + line, ny, coefs + ny * size, weights + ny * size, params, 1, target.mode)
            coefs += nx * step
            weights += nx * step
            _deliver(fresh + 2 * line, ny, coefs, weights, params, 2, target.mode)
            _deliver(fresh + 3 * line, ny, coefs + ny * size, weights + ny * size, params, 3, target.mode)


@_jit
def _synthesise_quad(table, n, taps, length, to, line):
    """Two pairs of image lines, of one half of the columns, from lines of the bands to every other scratch line."""
    size = taps.itemsize
    whole = n * size // VECTOR_BYTES * VECTOR_BYTES
    for k in range(0, whole, VECTOR_BYTES):
        v = _synthesise_lines(table, (k,), taps, length, 0)
        store(to + k, v[0])
        store(to + k + 2 * line, v[1])
        store(to + k + 4 * line, v[2])
        store(to + k + 6 * line, v[3])
    if whole < n * size:
        v = _synthesise_last_lines(table, (whole,), taps, length, n - whole // size)
        store(to + whole, v[0])
        store(to + whole + 2 * line, v[1])
        store(to + whole + 4 * line, v[2])
        store(to + whole + 6 * line, v[3])


@_jit
def _put_pixels(at, even, odd, add):
    low, high = zip_low(even, odd), zip_high(even, odd)
    if add:
        low = low + load(at, low)
        high = high + load(at + VECTOR_BYTES, high)
    store(at, low)
    store(at + VECTOR_BYTES, high)


@_jit
def _synthesise_pair(table, n, taps, length, shift, line, out, step, add):
    """Two image lines, from their a and d halves in scratch, to `out` or added to it."""
    for k in range(0, n * taps.itemsize, 2 * VECTOR_BYTES):
        e, o = shift + k, shift + k + 2 * line
        v = _synthesise_along(table, (e, e + VECTOR_BYTES, o, o + VECTOR_BYTES), taps, length, 0)
        at = out + 2 * k
        _put_pixels(at, v[0], v[1], add)
        _put_pixels(at + 2 * VECTOR_BYTES, v[2], v[3], add)
        _put_pixels(at + step, v[4], v[5], add)
        _put_pixels(at + step + 2 * VECTOR_BYTES, v[6], v[7], add)


@_jit
def _synthesise(low, filters, coefs, work, worker, b, level, out, origin, begin, end):
    """Image lines [2 begin, 2 end) of one level to `out`, whose first line is line `origin`; added at level 1."""
    length = filters.lengths[b]
    late = 2 if length % 4 == 0 else 0
    nx, ny = coefs.shape[1] >> level, coefs.shape[2] >> level
    size = coefs.itemsize
    # pixels 2j, 2j + 1 take their taps from lines j + first, j + first + 1, …
    start = 1 - length // 2
    first = 1 - length // 2 - (start + 1) // 2
    scratch, tables = work.scratch[worker], work.tables[worker]
    line = scratch.shape[1] * size
    parts = _address(scratch, 0) + HALO * size
    steps = (length + late) // 2
    _tabulate(tables[2], 0, 2, parts + first * size, size, 0, steps, steps)
    _tabulate(tables[2], 1, 2, parts + line + first * size, size, 0, steps, steps)
    line_taps, taps = filters.synthesis[1 if level == 1 else 0, b], filters.synthesis[0, b]
    plane, step = _address(coefs[b], 0), coefs.shape[2] * size
    out_step = out.shape[1] * size
    for j in range(begin, end, 2):
        _tabulate(tables[0], 0, 2, _address(low, 0), low.shape[1] * size, j + first, nx, steps + 1)
        _tabulate(tables[0], 1, 2, plane + nx * step, step, j + first, nx, steps + 1)
        _tabulate(tables[1], 0, 2, plane + ny * size, step, j + first, nx, steps + 1)
        _tabulate(tables[1], 1, 2, plane + nx * step + ny * size, step, j + first, nx, steps + 1)
        _synthesise_quad(tables[0], ny, line_taps, length, parts, line)
        _synthesise_quad(tables[1], ny, line_taps, length, parts + line, line)
        _wrap(scratch, ny)
        for i in range(j, min(j + 2, end)):
            _synthesise_pair(tables[2], ny, taps, length, 4 * (i - j) * line, line,
                             _address(out, 2 * i - origin), out_step, level == 1)


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
        for row in range(2 * (end - begin) + MAX_TAPS):
            i = (2 * begin - MARGIN + row) % nx
            filled = image.shape[1] if i < image.shape[0] else 0
            for k in range(filled):
                window[row, k] = image[i, k]
            window[row, filled:] = 0
        for b in range(filters.lengths.size):
            if filters.lengths[b]:
                _analyse(window, 2 * begin - MARGIN, filters, target, work, worker, b, 1,
                         _approx(work, (nx, ny), b, 1), begin, end)
                continue
            for i in range(2 * begin, 2 * end):
                for k in range(ny):
                    spare[k] = filters.gain * window[i - 2 * begin + MARGIN, k]
                _deliver(spare.ctypes.data, ny, _address(target.coefs[b], i), _address(target.weights[b], i),
                         target.params[b, 0], 0, target.mode)


@_entry
def transform_deeper(filters, target, work, owner, forth, back, worker, workers):
    """Levels 2, 3, … of the bases this worker owns: analysis if `forth`, synthesis if `back`."""
    shape = target.coefs.shape[1:]
    levels = target.params.shape[1]
    for b in range(filters.lengths.size):
        if owner[b] != worker or filters.lengths[b] == 0:
            continue
        if forth:
            for level in range(2, levels + 1):
                _analyse(_approx(work, shape, b, level - 1), 0, filters, target, work, worker, b, level,
                         _approx(work, shape, b, level), 0, shape[0] >> level)
        if back:
            for level in range(levels, 1, -1):
                out = _approx(work, shape, b, level - 1)
                low = target.coefs[b] if level == levels else _approx(work, shape, b, level)
                _synthesise(low, filters, target.coefs, work, worker, b, level, out, 0, 0, shape[0] >> level)


@_entry
def synthesise_finest(coefs, levels, filters, work, out, worker, workers):
    """Level 1 and Dirac: this worker's share of the lines of the image."""
    nx, ny = coefs.shape[1:]
    window = work.window[worker]
    first, last = _share(nx // 2, worker, workers)
    for begin in range(first, last, CHUNK):
        end = min(begin + CHUNK, last)
        window[:2 * (end - begin)] = 0
        for b in range(filters.lengths.size):
            if filters.lengths[b]:
                low = coefs[b] if levels == 1 else _approx(work, (nx, ny), b, 1)
                _synthesise(low, filters, coefs, work, worker, b, 1, window, 2 * begin, begin, end)
                continue
            for i in range(2 * begin, 2 * end):
                for k in range(ny):
                    window[i - 2 * begin, k] += filters.gain * coefs[b, i, k]
        for i in range(2 * begin, min(2 * end, out.shape[0])):
            for k in range(out.shape[1]):
                out[i, k] = window[i - 2 * begin, k]
