"""Banks of short filters for Numba kernels: the unrolled weighted sums of lines of pixels that wavelets are made of."""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from casa_sara.operators._vectors import move, register, splatted

__all__ = ["MAX_TAPS", "filter_bank"]

MAX_TAPS = 16
INT = ir.IntType(64)


def filter_bank(lags, along=False, masked=False):
    """Make the kernel of a bank of short filters, unrolled for every even length up to MAX_TAPS.

    The kernel is called as ``bank(lines, offsets, taps, length, lanes)`` and returns the tuple of vectors

        sum[n · len(lags) + o] = Σ_{t < length} taps[o mod 2, t] · vector at (line(t + lag_o) + offsets[n]),

    where `offsets` is a tuple of byte offsets and `taps` an array (2, ≥ length).  Every input vector is loaded once
    and every tap broadcast once.

    Across lines, for two offsets (V0, V1 are the vectors there) and lags (0, 0, 2, 2), which is the analysis of lines::

                      offsets[0]   offsets[1]
        lines[0]  ▶  ····[ V0 ]·······[ V1 ]····    taps[:, 0] to sums 0, 1
        lines[1]  ▶  ····[ V0 ]·······[ V1 ]····    taps[:, 1] to sums 0, 1
        lines[2]  ▶  ····[ V0 ]·······[ V1 ]····    taps[:, 2] to sums 0, 1;  taps[:, 0] to sums 2, 3
        lines[3]  ▶  ····[ V0 ]·······[ V1 ]····    taps[:, 3] to sums 0, 1;  taps[:, 1] to sums 2, 3
           ⋮             ▼            ▼
                     sums 0 … 3   sums 4 … 7       even sums with the taps of row 0, odd ones with those of row 1

    Along a line of pixels x, whose even and odd pixels lie apart, so that a step by two pixels is one value::

        line(0) = lines[0]              x0 x2 x4 x6 …
        line(1) = lines[1]              x1 x3 x5 x7 …
        line(2) = lines[0] + 1 value    x2 x4 x6 x8 …
        line(3) = lines[1] + 1 value    x3 x5 x7 x9 …
                                        ▼  ▼  ▼  ▼
                       one lane each:   k = 0, 1, 2, 3, …, of Σ_t taps[·, t] x[2k + t]

    Parameters
    ----------
    lags : callable
        Number of taps to the tuple of lags of the outputs.
    along : bool
        Filter along two interleaved lines: line(p) = lines[p mod 2] + p // 2 values, `lines` a tuple of two
        addresses.  Otherwise across lines: line(p) = lines[p], `lines` an int64 array of addresses.
    masked : bool
        Touch only the first `lanes` values of each line; without it `lanes` is ignored.
    """
    @intrinsic
    def bank(typingctx, lines, offsets, taps, length, lanes):
        vec = register(taps.dtype)
        sums = types.UniTuple(vec, len(offsets) * len(lags(2)))

        def codegen(context, builder, sig, args):
            lines_at, shifts, taps_at, count, first_lanes = args
            if along:
                line = _interleaved(builder, lines_at, vec.size)
            else:
                line = _tabulated(builder, context.make_array(lines)(context, builder, lines_at).data)
            starts = _tap_rows(builder, context.make_array(taps)(context, builder, taps_at), vec.size)
            shifts = cgutils.unpack_tuple(builder, shifts)
            found = _for_each_length(builder, count, lambda length: _unrolled(
                builder, vec, length, lags(length), line, starts, shifts, first_lanes if masked else None))
            return cgutils.pack_array(builder, found)

        return sums(lines, offsets, taps, types.intp, types.intp), codegen

    return bank


def _interleaved(builder, lines, size):
    """Address of line(p) along two interleaved lines, as a function of p."""
    pair = cgutils.unpack_tuple(builder, lines)
    return lambda p: builder.add(pair[p % 2], ir.Constant(INT, p // 2 * size))


def _tabulated(builder, table):
    """Address of line(p) in a table of addresses, as a function of p."""
    return lambda p: builder.load(builder.gep(table, [ir.Constant(INT, p)]))


def _tap_rows(builder, taps, size):
    """Pointers to the two rows of an array of taps."""
    row = builder.udiv(cgutils.unpack_tuple(builder, taps.strides)[0], ir.Constant(INT, size))
    return [taps.data, builder.gep(taps.data, [row])]


def _for_each_length(builder, length, build):
    """Branch to what `build` makes for each even length up to MAX_TAPS; return the vectors of the one that is run."""
    done = builder.append_basic_block("done")
    cases = {n: builder.append_basic_block(f"taps{n}") for n in range(2, MAX_TAPS + 1, 2)}
    switch = builder.switch(length, cases[MAX_TAPS])
    results = []
    for n, block in cases.items():
        if n < MAX_TAPS:
            switch.add_case(ir.Constant(INT, n), block)
        builder.position_at_end(block)
        results.append(build(n))
        builder.branch(done)
    builder.position_at_end(done)
    merged = [builder.phi(value.type) for value in results[0]]
    for values, block in zip(results, cases.values()):
        for phi, value in zip(merged, values):
            phi.add_incoming(value, block)
    return merged


def _unrolled(builder, vec, length, lags, line, taps, offsets, lanes):
    """The sums of `filter_bank` for one filter length, each rounded in the same way."""
    multiply_add = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(vec.llvm, 3 * [vec.llvm]), f"llvm.fmuladd.v{vec.width}f{8 * vec.size}")
    sums = [[None] * len(lags) for _ in offsets]
    factors = []
    for p in range(length + max(lags)):
        address = line(p)
        if p < length:
            index = [ir.Constant(INT, p)]
            factors.append([splatted(builder, [builder.load(builder.gep(row, index))], vec.llvm) for row in taps])
        for n, offset in enumerate(offsets):
            value = move(builder, vec, builder.add(address, offset), lanes=lanes)
            for o, lag in enumerate(lags):
                if 0 <= p - lag < length:
                    factor = factors[p - lag][o % 2]
                    sums[n][o] = builder.fmul(factor, value) if p == lag else \
                        builder.call(multiply_add, [factor, value, sums[n][o]])
    return sum(sums, [])
