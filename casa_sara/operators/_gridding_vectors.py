"""What gridding does with vectors: polynomials of the gridding kernel, rows of cells gathered and scattered."""

from __future__ import annotations

import functools

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from casa_sara.operators._vectors import LANE, Vector, element, scaled_sum, shuffled, splatted

__all__ = ["gather_rows", "pair_sums", "polynomials", "scale_pairs", "scatter_rows", "second_half_twice"]


@intrinsic
def scale_pairs(typing_context, lanes, even, odd):
    """Even lanes times `even`, odd lanes times `odd`."""

    def codegen(context, builder, signature, args):
        return builder.fmul(args[0], splatted(builder, args[1:], args[0].type))

    return lanes(lanes, lanes.scalar, lanes.scalar), codegen


@intrinsic
def pair_sums(typing_context, lanes):
    """(sum of the even lanes, sum of the odd lanes); the number of lanes is a power of two."""
    pair = types.UniTuple(lanes.scalar, 2)

    def codegen(context, builder, signature, args):
        rest, count = args[0], lanes.width
        while count > 2:
            count //= 2
            rest = builder.fadd(*(shuffled(builder, rest, list(range(start, start + count))) for start in (0, count)))
        return context.make_tuple(builder, pair, [builder.extract_element(rest, LANE(k)) for k in range(2)])

    return pair(lanes), codegen


@intrinsic
def polynomials(typing_context, coefs, first, second, terms, count):
    """len(count)/2 polynomials at `first`, and the same at `second`.

    `coefs` is (len(terms), len(count)/2) flattened, highest power first.
    """
    lanes, half = Vector(coefs.dtype, len(count)), Vector(coefs.dtype, len(count) // 2)

    def codegen(context, builder, signature, args):
        halves = [2 * lane // lanes.width for lane in range(lanes.width)]
        places = shuffled(builder, splatted(builder, args[1:3], lanes.llvm), halves)
        twice = [lane % half.width for lane in range(lanes.width)]
        offsets = [ir.IntType(64)(term * half.width) for term in range(len(terms))]
        pointers = [element(context, builder, coefs, args[0], offset, half) for offset in offsets]
        rows = [shuffled(builder, builder.load(pointer, align=half.size), twice) for pointer in pointers]

        def one_more(value, row):
            return builder.fadd(builder.fmul(value, places, flags=("contract",)), row, flags=("contract",))

        return functools.reduce(one_more, rows)

    return lanes(coefs, coefs.dtype, coefs.dtype, terms, count), codegen


@intrinsic
def second_half_twice(typing_context, lanes):
    """Each lane of the second half twice: for the real and the imaginary part."""

    def codegen(context, builder, signature, args):
        return shuffled(builder, args[0], [(lanes.width + lane) // 2 for lane in range(lanes.width)])

    return lanes(lanes), codegen


def _rows(context, builder, array_type, args, lanes, width):
    """Addresses of `width` rows, `stride` apart, from args = (array, first, stride, …)."""
    array, index, stride = args[:3]
    for _ in range(width):
        yield element(context, builder, array_type, array, index, lanes)
        index = builder.add(index, stride)


@intrinsic
def gather_rows(typing_context, array, first, stride, factors, width):
    """Σ_i factors[i] · lanes at array[first + i·stride], i < len(width), of a contiguous 1-D array."""

    def codegen(context, builder, signature, args):
        total = ir.Constant(args[3].type, None)
        for i, row in enumerate(_rows(context, builder, array, args, factors, len(width))):
            factor = builder.extract_element(args[3], LANE(i))
            total = scaled_sum(builder, builder.load(row, align=factors.size), factor, total)
        return total

    return factors(array, types.intp, types.intp, factors, width), codegen


@intrinsic
def scatter_rows(typing_context, array, first, stride, factors, lanes, width):
    """Add factors[i] · lanes to array[first + i·stride …], i < len(width): the transpose of `gather_rows`."""

    def codegen(context, builder, signature, args):
        align = factors.size
        for i, row in enumerate(_rows(context, builder, array, args, factors, len(width))):
            factor = builder.extract_element(args[3], LANE(i))
            builder.store(scaled_sum(builder, args[4], factor, builder.load(row, align=align)), row, align=align)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, factors, lanes, width), codegen
