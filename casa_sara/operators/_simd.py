"""Vector registers for Numba kernels, and the short filters that run on them.

LLVM's own vectoriser fails on wavelet filters: it cannot prove that sixteen input lines and the output do not
overlap, it halves the register width, and it does not unroll the taps.  The kernels therefore say what they mean:
a `Vector` is as wide as the processor's registers, `load` and `store` move it between a register and an address in
memory (a plain integer), and `filter_bank` makes the unrolled weighted sums.
"""

from __future__ import annotations

import operator

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.extending import intrinsic, overload, register_model

__all__ = ["VECTOR_BYTES", "MAX_TAPS", "Vector", "filter_bank", "load", "load_first", "store", "store_first",
           "prefetch", "splat", "lane_bytes", "minimum", "maximum", "evens", "odds", "zip_low", "zip_high"]

MAX_TAPS = 16
INT, LANE = ir.IntType(64), ir.IntType(32)


def _register_bytes():
    features = llvm.get_host_cpu_features()
    return 64 if features.get("avx512f") else 32 if features.get("avx") else 16


VECTOR_BYTES = _register_bytes()


class Vector(types.Type):
    """Numba type of one register full of `scalar`."""

    def __init__(self, scalar):
        self.scalar, self.size = scalar, scalar.bitwidth // 8
        self.width = VECTOR_BYTES // self.size
        super().__init__(name=f"Vector({scalar}, {self.width})")

    @property
    def llvm(self):
        return ir.VectorType(ir.FloatType() if self.size == 4 else ir.DoubleType(), self.width)


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, fe_type.llvm)


def _splat(builder, scalar, vector):
    undefined = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(LANE, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(LANE, vector.count), [0] * vector.count))


def _move(builder, vec, address, value=None, lanes=None):
    """Load from (`value` None) or store to `address`; only the first `lanes` lanes where given, the rest reads 0."""
    pointer = builder.inttoptr(address, vec.llvm.as_pointer())
    if lanes is None:
        return builder.load(pointer, align=vec.size) if value is None else builder.store(value, pointer, align=vec.size)
    numbers = ir.Constant(ir.VectorType(LANE, vec.width), list(range(vec.width)))
    mask = builder.icmp_signed("<", numbers, _splat(builder, builder.trunc(lanes, LANE), numbers.type))
    kind, result, before, after = ("load", vec.llvm, [], [ir.Constant(vec.llvm, None)]) if value is None else \
        ("store", ir.VoidType(), [value], [])
    arguments = [*before, pointer, ir.Constant(LANE, vec.size), mask, *after]
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(result, [a.type for a in arguments]),
        f"llvm.masked.{kind}.v{vec.width}f{8 * vec.size}.p0")
    return builder.call(function, arguments)


@intrinsic
def load(typingctx, address, like):
    """Vector at `address`, of the type of `like`."""
    vec = like
    return vec(types.intp, like), lambda context, builder, sig, args: _move(builder, vec, args[0])


@intrinsic
def load_first(typingctx, address, lanes, like):
    """As `load`, but touches only the first `lanes` values; the other lanes are 0."""
    vec = like
    return vec(types.intp, types.intp, like), lambda context, builder, sig, args: _move(
        builder, vec, args[0], lanes=args[1])


@intrinsic
def store(typingctx, address, value):
    """Write a vector to `address`."""
    def codegen(context, builder, sig, args):
        _move(builder, sig.args[1], *args)
    return types.void(types.intp, value), codegen


@intrinsic
def store_first(typingctx, address, value, lanes):
    """Write the first `lanes` values of a vector to `address`."""
    def codegen(context, builder, sig, args):
        _move(builder, sig.args[1], *args)
    return types.void(types.intp, value, types.intp), codegen


@intrinsic
def splat(typingctx, scalar):
    """Vector with `scalar` in every lane."""
    vec = Vector(scalar)
    return vec(scalar), lambda context, builder, sig, args: _splat(builder, args[0], vec.llvm)


@intrinsic
def prefetch(typingctx, address):
    """Ask for the cache line at `address`, which need not exist."""
    def codegen(context, builder, sig, args):
        pointer = builder.inttoptr(args[0], ir.IntType(8).as_pointer())
        hints = [ir.Constant(LANE, hint) for hint in (0, 2, 1)]  # to read; into the second-level cache; data
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), [pointer.type, *[LANE] * 3]), "llvm.prefetch.p0")
        builder.call(function, [pointer, *hints])
        return context.get_dummy_value()
    return types.void(types.intp), codegen


@intrinsic
def lane_bytes(typingctx, vector):
    """Bytes of one lane of a vector."""
    return types.intp(vector), lambda context, builder, sig, args: ir.Constant(INT, vector.size)


def _binary(build):
    @intrinsic
    def operation(typingctx, a, b):
        return a(a, b), lambda context, builder, sig, args: build(builder, *args)
    return operation


def _lanes(pick):
    """Two vectors of n lanes to one: lane i is number pick(i, n) of the 2n."""
    def build(builder, a, b):
        n = a.type.count
        return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(LANE, n), [pick(i, n) for i in range(n)]))
    return _binary(build)


evens = _lanes(lambda i, n: 2 * i)
odds = _lanes(lambda i, n: 2 * i + 1)
zip_low = _lanes(lambda i, n: i // 2 + i % 2 * n)
zip_high = _lanes(lambda i, n: (i + n) // 2 + i % 2 * n)
minimum = _binary(lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))
maximum = _binary(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))


def _overload(symbol, build):
    operation = _binary(build)

    @overload(symbol)
    def implementation(a, b):
        if isinstance(a, Vector) and a == b:
            return lambda a, b: operation(a, b)


_overload(operator.add, lambda builder, a, b: builder.fadd(a, b))
_overload(operator.sub, lambda builder, a, b: builder.fsub(a, b))
_overload(operator.mul, lambda builder, a, b: builder.fmul(a, b))
_overload(operator.truediv, lambda builder, a, b: builder.fdiv(a, b))


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
        vec = Vector(taps.dtype)
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
            factors.append([_splat(builder, builder.load(builder.gep(row, index)), vec.llvm) for row in taps])
        for n, offset in enumerate(offsets):
            value = _move(builder, vec, builder.add(address, offset), lanes=lanes)
            for o, lag in enumerate(lags):
                if 0 <= p - lag < length:
                    factor = factors[p - lag][o % 2]
                    sums[n][o] = builder.fmul(factor, value) if p == lag else \
                        builder.call(multiply_add, [factor, value, sums[n][o]])
    return sum(sums, [])
