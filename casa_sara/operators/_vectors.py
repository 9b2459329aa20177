"""Vectors for Numba kernels: a type for a few numbers that the processor handles at once, and what is done with them.

LLVM's own vectoriser fails on the short loops of wavelets and of gridding: it cannot prove that input and output do not
overlap, it halves the register width, and it does not unroll. The kernels therefore say what they mean. A `Vector` is
as wide as the processor's registers (:func:`register`), or has a given number of lanes, which LLVM maps to registers.
It is moved to and from an address in memory (a plain integer; `load`, `store`), or elements of a contiguous array
(`load_at`, `store_at`), where the number of lanes is the length of a tuple, so that it is a constant of the compiled
function.
"""

from __future__ import annotations

import operator

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.extending import intrinsic, overload, register_model

__all__ = ["LANE", "VECTOR_BYTES", "Vector", "element", "evens", "lane_bytes", "load", "load_at", "load_first",
           "maximum", "minimum", "move", "multiply_add", "odds", "prefetch", "register", "scaled_sum", "shuffled",
           "splat", "splatted", "store", "store_at", "store_first", "zeros", "zip_high", "zip_low"]

LANE = ir.IntType(32)  # numbers of lanes, for LLVM


def _register_bytes():
    features = llvm.get_host_cpu_features()
    return 64 if features.get("avx512f") else 32 if features.get("avx") else 16


VECTOR_BYTES = _register_bytes()


class Vector(types.Type):
    """Numba type of `width` numbers of one floating-point type."""

    def __init__(self, scalar, width):
        self.scalar, self.width, self.size = scalar, width, scalar.bitwidth // 8
        super().__init__(name=f"Vector({scalar}, {width})")

    @property
    def llvm(self):
        return ir.VectorType(ir.FloatType() if self.size == 4 else ir.DoubleType(), self.width)


def register(scalar):
    """Return the type of a vector that fills one register."""
    return Vector(scalar, VECTOR_BYTES * 8 // scalar.bitwidth)


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, fe_type.llvm)


# For the writers of intrinsics: values of LLVM in, values of LLVM out.


def shuffled(builder, vector, pattern):
    """The lanes of a vector with the numbers in `pattern`."""
    return builder.shuffle_vector(vector, vector, ir.Constant(ir.VectorType(LANE, len(pattern)), pattern))


def splatted(builder, values, vector):
    """A vector of this type of LLVM with the given scalars in its lanes, again and again."""
    lanes = ir.Constant(vector, ir.Undefined)
    for lane, value in enumerate(values):
        lanes = builder.insert_element(lanes, value, LANE(lane))
    return shuffled(builder, lanes, [lane % len(values) for lane in range(vector.count)])


def scaled_sum(builder, vector, scalar, addend):
    """vector · scalar + addend, fused where the processor can."""
    product = builder.fmul(vector, splatted(builder, [scalar], vector.type), flags=("contract",))
    return builder.fadd(product, addend, flags=("contract",))


def element(context, builder, array_type, array, index, vector):
    """Address of array[index] as a pointer to a vector."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), vector.llvm.as_pointer())


def move(builder, vec, address, value=None, lanes=None):
    """Load from (`value` None) or store to `address`; only the first `lanes` lanes where given, the rest reads 0."""
    pointer = builder.inttoptr(address, vec.llvm.as_pointer())
    if lanes is None:
        return builder.load(pointer, align=vec.size) if value is None else builder.store(value, pointer, align=vec.size)
    numbers = ir.Constant(ir.VectorType(LANE, vec.width), list(range(vec.width)))
    mask = builder.icmp_signed("<", numbers, splatted(builder, [builder.trunc(lanes, LANE)], numbers.type))
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
    return vec(types.intp, like), lambda context, builder, sig, args: move(builder, vec, args[0])


@intrinsic
def load_first(typingctx, address, lanes, like):
    """As `load`, but touches only the first `lanes` values; the other lanes are 0."""
    vec = like
    return vec(types.intp, types.intp, like), lambda context, builder, sig, args: move(
        builder, vec, args[0], lanes=args[1])


@intrinsic
def store(typingctx, address, value):
    """Write a vector to `address`."""
    def codegen(context, builder, sig, args):
        move(builder, sig.args[1], *args)
    return types.void(types.intp, value), codegen


@intrinsic
def store_first(typingctx, address, value, lanes):
    """Write the first `lanes` values of a vector to `address`."""
    def codegen(context, builder, sig, args):
        move(builder, sig.args[1], *args)
    return types.void(types.intp, value, types.intp), codegen


@intrinsic
def load_at(typingctx, array, index, count):
    """len(count) consecutive elements of a contiguous 1-D array from `index` on."""
    vec = Vector(array.dtype, len(count))

    def codegen(context, builder, sig, args):
        return builder.load(element(context, builder, array, args[0], args[1], vec), align=vec.size)
    return vec(array, types.intp, count), codegen


@intrinsic
def store_at(typingctx, array, index, vector):
    """Write a vector to consecutive elements of a contiguous 1-D array from `index` on."""
    def codegen(context, builder, sig, args):
        builder.store(args[2], element(context, builder, array, args[0], args[1], vector), align=vector.size)
        return context.get_dummy_value()
    return types.void(array, types.intp, vector), codegen


@intrinsic
def zeros(typingctx, array, count):
    """len(count) zeros of the type of a 1-D array."""
    vec = Vector(array.dtype, len(count))
    return vec(array, count), lambda context, builder, sig, args: ir.Constant(vec.llvm, None)


@intrinsic
def multiply_add(typingctx, vector, scalar, addend):
    """vector · scalar + addend."""
    return vector(vector, vector.scalar, vector), lambda context, builder, sig, args: scaled_sum(builder, *args)


@intrinsic
def splat(typingctx, scalar):
    """Register with `scalar` in every lane."""
    vec = register(scalar)
    return vec(scalar), lambda context, builder, sig, args: splatted(builder, args, vec.llvm)


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
    return types.intp(vector), lambda context, builder, sig, args: ir.Constant(ir.IntType(64), vector.size)


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
