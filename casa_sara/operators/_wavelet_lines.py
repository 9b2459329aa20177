"""Compiled kernels on lines of an image: the two filter passes of a wavelet transform, and the dual update.

Analysis along an axis of even length n, with the reversed filters lo and hi of F taps (PyWavelets' periodization):

    a[k] = Σ_t lo[t] x[(2k + s + t) mod n],   d[k] = Σ_t hi[t] x[(2k + s + t) mod n],   s = 1 − F/2;

synthesis is its transpose.  Across lines, the filters take whole lines, given by a table of addresses, to scratch lines
that stay in the L1 cache; then these are filtered along themselves, and the coefficients go to their places, or into
the dual update, from the registers.  Addresses, steps and offsets are in bytes.
"""

from __future__ import annotations

from typing import NamedTuple

from numba.extending import register_jitable

from casa_sara.operators._filter_bank import MAX_TAPS, filter_bank
from casa_sara.operators._vectors import (
    VECTOR_BYTES,
    evens,
    lane_bytes,
    load,
    load_first,
    maximum,
    minimum,
    odds,
    prefetch,
    splat,
    store,
    store_first,
    zip_high,
    zip_low,
)
from casa_sara.runtime import jit

__all__ = ["KEEP", "CLIP", "CLIP_WEIGHTED", "HALO", "SCRATCH_ROWS", "TABLE_SIZE", "Place", "compiled",
           "late", "tabulate", "wrap", "update_pixels", "analyse_lines", "analyse_along", "synthesise_lines",
           "synthesise_along"]

KEEP, CLIP, CLIP_WEIGHTED = range(3)
HALO = 16  # columns before and after the values of a scratch line
SCRATCH_ROWS = 8
TABLE_SIZE = 2 * MAX_TAPS

compiled = jit.inner(error_model="numpy", fastmath={"contract"})


class Place(NamedTuple):
    """Addresses of a line of the band aa, and the ways to the bands ad (right), da (down) and dd (both)."""

    coefs: int
    weights: int
    right: int
    down: int


@register_jitable
def late(length):
    """Lag of the odd pixels of a synthesis behind the even ones, in lines; a step is two lines, a and d."""
    return 2 if length % 4 == 0 else 0


def _two_pairs(length):
    return 0, late(length), 2, 2 + late(length)


_analyse_bank = filter_bank(lambda length: (0, 0, 2, 2))
_analyse_bank_along = filter_bank(lambda length: (0, 0), along=True)
_synthesise_bank = filter_bank(_two_pairs)
_synthesise_bank_masked = filter_bank(_two_pairs, masked=True)
_synthesise_bank_along = filter_bank(lambda length: (0, late(length)), along=True)


@compiled
def tabulate(table, every, base, step, first, period, count):
    """Addresses of lines first, first + 1, … (mod period) to each `every`-th entry of the table."""
    i = first % period
    for p in range(count):
        table[every * p] = base + i * step
        i += 1
        if i == period:
            i = 0


@compiled
def wrap(scratch, n):
    """Continue the first eight scratch lines, n values from column HALO, periodically."""
    for line in range(8):
        for i in range(1, MAX_TAPS // 4 + 1):
            scratch[line, HALO - i] = scratch[line, HALO + n - i]
        for i in range(MAX_TAPS // 4 + 1):
            scratch[line, HALO + n + i] = scratch[line, HALO + i]


@compiled
def _combine(old, fresh, weight, params, mode):
    """New value of a coefficient, params = (κ, ρ).

    KEEP: fresh;  CLIP: old + ρ(clip(old + fresh, ±κ) − old);  CLIP_WEIGHTED: the same with ±κ·weight.
    """
    if mode == KEEP:
        return fresh
    limit, relaxation = params
    if mode == CLIP_WEIGHTED:
        limit = limit * weight
    clipped = minimum(maximum(old + fresh, (limit - limit) - limit), limit)
    return old + relaxation * (clipped - old)


@compiled
def _update(at, fresh, weight_at, params, mode, left):
    """Combine a vector of fresh coefficients, `left` bytes of it valid, into those at address `at`."""
    if left >= VECTOR_BYTES:
        store(at, _combine(load(at, fresh), fresh, load(weight_at, fresh), params, mode))
    elif left > 0:
        lanes = left // lane_bytes(fresh)
        old, weight = load_first(at, lanes, fresh), load_first(weight_at, lanes, fresh)
        store_first(at, _combine(old, fresh, weight, params, mode), lanes)


@compiled
def analyse_lines(table, taps, length, to, line, place, step):
    """Two lines of a and of d of the lines in `table`, split into even and odd pixels, to eight scratch lines.

    Meanwhile fetch what `place` and the line after it hold.
    """
    for k in range(0, place.right, VECTOR_BYTES):
        v = _analyse_bank(table, (2 * k, 2 * k + VECTOR_BYTES), taps, length, 0)
        for i in range(2):
            soon = place.coefs + i * step + k
            prefetch(soon + place.right)
            prefetch(soon + place.down)
            prefetch(soon + place.down + place.right)
        for o in range(4):
            at = to + k + 2 * o * line
            store(at, evens(v[o], v[o + 4]))
            store(at + line, odds(v[o], v[o + 4]))


@compiled
def analyse_along(pixels, taps, length, shift, line, low, place, params, mode):
    """Filter an a and a d line along themselves; the bands go to `place`, but aa to `low` if that is an address."""
    both = splat(params[0]), splat(params[1])
    coefs, weights, right, down = place
    for k in range(0, right, 2 * VECTOR_BYTES):
        a, d = shift + k, shift + k + 2 * line
        v = _analyse_bank_along(pixels, (a, a + VECTOR_BYTES, d, d + VECTOR_BYTES), taps, length, 0)
        for i in range(2):
            at = k + i * VECTOR_BYTES
            left = right - at
            if low:
                store(low + at, v[2 * i])
            else:
                _update(coefs + at, v[2 * i], weights + at, both, mode, left)
            _update(coefs + right + at, v[2 * i + 1], weights + right + at, both, mode, left)
            at += down
            _update(coefs + at, v[2 * i + 4], weights + at, both, mode, left)
            _update(coefs + right + at, v[2 * i + 5], weights + right + at, both, mode, left)


@compiled
def _store_lines(at, line, v, i):
    """The four sums of offset `i` to every other scratch line."""
    for o in range(4):
        store(at + 2 * o * line, v[4 * i + o])


@compiled
def synthesise_lines(table, n, taps, length, to, line):
    """Four image lines, in one half of the columns, of the lines in `table` to every other scratch line."""
    size, width = taps.itemsize, 2 * VECTOR_BYTES
    whole = n * size // width * width
    for k in range(0, whole, width):
        v = _synthesise_bank(table, (k, k + VECTOR_BYTES), taps, length, 0)
        _store_lines(to + k, line, v, 0)
        _store_lines(to + k + VECTOR_BYTES, line, v, 1)
    for k in range(whole, n * size, VECTOR_BYTES):
        v = _synthesise_bank_masked(table, (k,), taps, length, n - k // size)
        _store_lines(to + k, line, v, 0)


@compiled
def _put_pixels(at, even, odd, add):
    """Interleave even and odd pixels."""
    low, high = zip_low(even, odd), zip_high(even, odd)
    if add:
        low, high = low + load(at, low), high + load(at + VECTOR_BYTES, high)
    store(at, low)
    store(at + VECTOR_BYTES, high)


@compiled
def synthesise_along(halves, n, taps, length, shift, line, to, step, add):
    """Two image lines, of their a and d halves in scratch, to `to` or added to what is there."""
    for k in range(0, n * taps.itemsize, 2 * VECTOR_BYTES):
        one, two = shift + k, shift + k + 2 * line
        v = _synthesise_bank_along(halves, (one, one + VECTOR_BYTES, two, two + VECTOR_BYTES), taps, length, 0)
        for i in range(2):
            at = to + 2 * k + 2 * i * VECTOR_BYTES
            _put_pixels(at, v[2 * i], v[2 * i + 1], add)
            _put_pixels(at + step, v[2 * i + 4], v[2 * i + 5], add)


@compiled
def update_pixels(pixels, place, gain, params, mode):
    """Combine a line of pixels, times the gain, into the Dirac coefficients."""
    gain, both = splat(gain), (splat(params[0]), splat(params[1]))
    for k in range(0, place.right, VECTOR_BYTES):
        _update(place.coefs + k, gain * load(pixels + k, gain), place.weights + k, both, mode, place.right - k)
