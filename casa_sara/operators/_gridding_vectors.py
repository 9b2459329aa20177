"""Explicit vectors for the short loops of gridding, inside numba functions.

LLVM's own vectoriser leaves these loops scalar, which costs a factor of five.  A `Lanes` is a
value of a fixed number of lanes, which LLVM maps to the registers that the processor has.  The
number comes from the length of a tuple, so it is a constant of the compiled function.
"""

from __future__ import annotations

import functools

from llvmlite import ir
from numba.core import types
from numba.core.datamodel import models
from numba.extending import intrinsic, register_model

__all__ = ["gather_rows", "load", "multiply", "multiply_add", "pair_sums", "polynomials", "scale_pairs", "scatter_rows",
           "second_half_twice", "store", "zeros"]

INT = ir.IntType(32)


class Lanes(types.Type):
    """`count` numbers of one floating-point type."""

    def __init__(self, scalar, count):
        self.scalar, self.count = scalar, count
        super().__init__(name=f"Lanes({scalar}, {count})")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm, lanes):
        scalar = ir.FloatType() if lanes.scalar == types.float32 else ir.DoubleType()
        super().__init__(dmm, lanes, ir.VectorType(scalar, lanes.count))


def _pointer(context, builder, array_type, array, index, lanes):
    """Address of array[index] as a pointer to lanes."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), context.get_value_type(lanes).as_pointer())


def _lanes_of(builder, vector, pattern):
    """The lanes of a vector with the numbers in `pattern`."""
    return builder.shuffle_vector(vector, vector, ir.Constant(ir.VectorType(INT, len(pattern)), pattern))


def _first_lanes(builder, values, vector):
    """A vector whose first lanes are the given scalars."""
    lanes = ir.Constant(vector, ir.Undefined)
    for lane, value in enumerate(values):
        lanes = builder.insert_element(lanes, value, INT(lane))
    return lanes


def _cycle(builder, values, vector):
    """The given scalars, again and again."""
    pattern = [lane % len(values) for lane in range(vector.count)]
    return _lanes_of(builder, _first_lanes(builder, values, vector), pattern)


def _multiply_add(builder, lanes, scalar, addend):
    """lanes · scalar + addend, fused where the processor can."""
    product = builder.fmul(lanes, _cycle(builder, [scalar], lanes.type), flags=("contract",))
    return builder.fadd(product, addend, flags=("contract",))


@intrinsic
def load(typing_context, array, index, count):
    """len(count) consecutive elements of a contiguous 1-D array from `index` on."""
    lanes = Lanes(array.dtype, len(count))

    def codegen(context, builder, signature, args):
        pointer = _pointer(context, builder, array, args[0], args[1], lanes)
        return builder.load(pointer, align=array.dtype.bitwidth // 8)

    return lanes(array, types.intp, count), codegen


@intrinsic
def zeros(typing_context, array, count):
    """len(count) zeros of the type of a 1-D array."""
    lanes = Lanes(array.dtype, len(count))

    def codegen(context, builder, signature, args):
        return ir.Constant(context.get_value_type(lanes), None)

    return lanes(array, count), codegen


@intrinsic
def store(typing_context, array, index, lanes):
    """Write lanes to consecutive elements of a contiguous 1-D array from `index` on."""

    def codegen(context, builder, signature, args):
        pointer = _pointer(context, builder, array, args[0], args[1], lanes)
        builder.store(args[2], pointer, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), codegen


@intrinsic
def multiply(typing_context, left, right):
    """left · right."""
    return left(left, left), lambda context, builder, signature, args: builder.fmul(*args)


@intrinsic
def multiply_add(typing_context, lanes, scalar, addend):
    """lanes · scalar + addend."""
    return lanes(lanes, lanes.scalar, lanes), lambda context, builder, signature, args: _multiply_add(builder, *args)


@intrinsic
def scale_pairs(typing_context, lanes, even, odd):
    """Even lanes times `even`, odd lanes times `odd`."""

    def codegen(context, builder, signature, args):
        return builder.fmul(args[0], _cycle(builder, args[1:], args[0].type))

    return lanes(lanes, lanes.scalar, lanes.scalar), codegen


@intrinsic
def pair_sums(typing_context, lanes):
    """(sum of the even lanes, sum of the odd lanes); the number of lanes is a power of two."""
    pair = types.UniTuple(lanes.scalar, 2)

    def codegen(context, builder, signature, args):
        rest, count = args[0], lanes.count
        while count > 2:
            count //= 2
            lower, upper = (ir.Constant(ir.VectorType(INT, count), list(range(start, start + count)))
                            for start in (0, count))
            rest = builder.fadd(*(builder.shuffle_vector(rest, rest, half) for half in (lower, upper)))
        return context.make_tuple(builder, pair, [builder.extract_element(rest, INT(k)) for k in range(2)])

    return pair(lanes), codegen


@intrinsic
def polynomials(typing_context, coefs, first, second, terms, count):
    """len(count)/2 polynomials at `first`, and the same at `second`.

    `coefs` is (len(terms), len(count)/2) flattened, highest power first.
    """
    lanes, half = Lanes(coefs.dtype, len(count)), Lanes(coefs.dtype, len(count) // 2)

    def codegen(context, builder, signature, args):
        vector = context.get_value_type(lanes)
        halves = [2 * lane // lanes.count for lane in range(lanes.count)]
        places = _lanes_of(builder, _first_lanes(builder, args[1:3], vector), halves)
        twice = [lane % half.count for lane in range(lanes.count)]
        offsets = [ir.IntType(64)(term * half.count) for term in range(len(terms))]
        pointers = [_pointer(context, builder, coefs, args[0], offset, half) for offset in offsets]
        rows = [_lanes_of(builder, builder.load(pointer, align=coefs.dtype.bitwidth // 8), twice) for pointer in pointers]

        def one_more(value, row):
            return builder.fadd(builder.fmul(value, places, flags=("contract",)), row, flags=("contract",))

        return functools.reduce(one_more, rows)

    return lanes(coefs, coefs.dtype, coefs.dtype, terms, count), codegen


@intrinsic
def second_half_twice(typing_context, lanes):
    """Each lane of the second half twice: for the real and the imaginary part."""

    def codegen(context, builder, signature, args):
        return _lanes_of(builder, args[0], [(lanes.count + lane) // 2 for lane in range(lanes.count)])

    return lanes(lanes), codegen


def _rows(context, builder, array_type, args, lanes, width):
    """Addresses of `width` rows, `stride` apart, from args = (array, first, stride, …)."""
    array, index, stride = args[:3]
    for _ in range(width):
        yield _pointer(context, builder, array_type, array, index, lanes)
        index = builder.add(index, stride)


@intrinsic
def gather_rows(typing_context, array, first, stride, factors, width):
    """Σ_i factors[i] · lanes at array[first + i·stride], i < len(width), of a contiguous 1-D array."""

    def codegen(context, builder, signature, args):
        total = ir.Constant(args[3].type, None)
        for i, row in enumerate(_rows(context, builder, array, args, factors, len(width))):
            factor = builder.extract_element(args[3], INT(i))
            total = _multiply_add(builder, builder.load(row, align=array.dtype.bitwidth // 8), factor, total)
        return total

    return factors(array, types.intp, types.intp, factors, width), codegen


@intrinsic
def scatter_rows(typing_context, array, first, stride, factors, lanes, width):
    """Add factors[i] · lanes to array[first + i·stride …], i < len(width): the transpose of `gather_rows`."""

    def codegen(context, builder, signature, args):
        align = array.dtype.bitwidth // 8
        for i, row in enumerate(_rows(context, builder, array, args, factors, len(width))):
            factor = builder.extract_element(args[3], INT(i))
            builder.store(_multiply_add(builder, args[4], factor, builder.load(row, align=align)), row, align=align)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, factors, lanes, width), codegen
