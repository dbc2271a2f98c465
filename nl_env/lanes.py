"""Eight numbers at a time: SIMD values for the inner loops of the renderer and the event camera.

A span of a surface is a few pixels long, and left to itself a compiler works the odd ones off one by one,
with a jump each. Here kernels say what they want: they handle eight pixels per step, mask the ones beyond
the end of a span, and look eight texels up at once. Every operation rounds exactly as written, so the bits
of an image depend neither on the optimiser nor on where a loop was cut.

Values are vectors of eight float32 (:func:`splat` of a float32), int32, or truth values. ``+``, ``-``, ``*``,
``/`` work on floats, ``+``, ``-``, ``&``, ``|``, ``<<`` and ``>>`` (which shifts zeros in) on integers, ``&``
and ``|`` on truth values, and ``<``, ``>``, ``<=``, ``>=`` compare. None of this may run under a fast-math
flag: use :data:`EXACT`.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import extending, njit, types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable

LANES = 8
"""Numbers in a vector; arrays need that many spare columns behind the last one in use."""
EXACT: dict[str, Any] = {
    "fastmath": False, "error_model": "numpy", "cache": True, "boundscheck": False, "forceinline": True
}  # fmt: skip
"""Options of the functions that handle vectors. Without the first one they would take on their caller's."""

intrinsic: Any = extending.intrinsic  # its annotations describe the function that is written, not called
Builder = Any
"""An ``ir.IRBuilder``; llvmlite has no types."""
Value = Any
"""An ``ir.Value``."""
_SINGLE, _INT, _BIT = ir.FloatType(), ir.IntType(32), ir.IntType(1)


class Lanes(types.Type):  # type: ignore[misc]
    """The type of a vector of eight ``element``."""

    def __init__(self, element: types.Type) -> None:
        self.element = element
        super().__init__(name=f"lanes({element})")


FLOATS, INTS, TRUTHS = Lanes(types.float32), Lanes(types.int32), Lanes(types.boolean)
_VECTORS = {
    FLOATS: ir.VectorType(_SINGLE, LANES),
    INTS: ir.VectorType(_INT, LANES),
    TRUTHS: ir.VectorType(_BIT, LANES),
}


_NAMES = {FLOATS: "v8f32", INTS: "v8i32"}
"""What LLVM's intrinsics call the vectors."""


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, lanes: Lanes) -> None:
        super().__init__(manager, lanes, _VECTORS[lanes])


def _operator(symbol: Any, operands: Lanes, result: Lanes, build: Callable[..., Value]) -> None:
    """Let ``symbol`` combine two vectors of one type."""

    @type_callable(symbol)
    def _typed(context: Any) -> Callable[..., Any]:
        def of(left: Any, right: Any) -> Any:
            return result if left == operands and right == operands else None

        return of

    @lower_builtin(symbol, operands, operands)
    def _lowered(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, Value]) -> Value:
        return build(builder, *arguments)


_operator(operator.add, FLOATS, FLOATS, ir.IRBuilder.fadd)
_operator(operator.sub, FLOATS, FLOATS, ir.IRBuilder.fsub)
_operator(operator.mul, FLOATS, FLOATS, ir.IRBuilder.fmul)
_operator(operator.truediv, FLOATS, FLOATS, ir.IRBuilder.fdiv)
_operator(operator.lt, FLOATS, TRUTHS, lambda builder, a, b: builder.fcmp_ordered("<", a, b))
_operator(operator.gt, FLOATS, TRUTHS, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_operator(operator.le, FLOATS, TRUTHS, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
_operator(operator.ge, FLOATS, TRUTHS, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
_operator(operator.add, INTS, INTS, ir.IRBuilder.add)
_operator(operator.sub, INTS, INTS, ir.IRBuilder.sub)
_operator(operator.mul, INTS, INTS, ir.IRBuilder.mul)
_operator(operator.and_, INTS, INTS, ir.IRBuilder.and_)
_operator(operator.or_, INTS, INTS, ir.IRBuilder.or_)
_operator(operator.lshift, INTS, INTS, ir.IRBuilder.shl)
_operator(operator.rshift, INTS, INTS, ir.IRBuilder.lshr)
_operator(operator.lt, INTS, TRUTHS, lambda builder, a, b: builder.icmp_signed("<", a, b))
_operator(operator.gt, INTS, TRUTHS, lambda builder, a, b: builder.icmp_signed(">", a, b))
_operator(operator.eq, INTS, TRUTHS, lambda builder, a, b: builder.icmp_signed("==", a, b))
_operator(operator.and_, TRUTHS, TRUTHS, ir.IRBuilder.and_)
_operator(operator.or_, TRUTHS, TRUTHS, ir.IRBuilder.or_)


def _call(builder: Builder, name: str, result: Any, arguments: list[Value]) -> Value:
    """Call an LLVM intrinsic."""
    kind = ir.FunctionType(result, [a.type for a in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


@intrinsic
def splat(typingctx, number):  # type: ignore[no-untyped-def]
    """Eight times the float32, or integer that fits 32 bits, ``number``."""
    result = INTS if isinstance(number, types.Integer) else FLOATS

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value]) -> Value:
        vector = _VECTORS[result]
        single = context.cast(builder, arguments[0], signature.args[0], result.element)
        one = builder.insert_element(ir.Constant(vector, ir.Undefined), single, _INT(0))
        order = ir.Constant(_VECTORS[INTS], [0] * LANES)
        return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), order)

    return result(number), codegen


@intrinsic
def ramp(typingctx):  # type: ignore[no-untyped-def]
    """The integers 0 to 7."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[()]) -> Value:
        return ir.Constant(_VECTORS[INTS], list(range(LANES)))

    return INTS(), codegen


@intrinsic
def row_of(typingctx, array, row):  # type: ignore[no-untyped-def]
    """Where row ``row`` of an array begins, for :func:`load`, :func:`store` and :func:`gather`.

    Functions that are given arrays count references to them, even when they are inlined; a row does not.
    """
    result = types.CPointer(array.dtype)

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, Value]) -> Value:
        kind, index = signature.args
        array_ = context.make_array(kind)(context, builder, arguments[0])
        zero = context.get_constant(types.intp, 0)
        first = context.cast(builder, arguments[1], index, types.intp)
        indices = [first, *[zero] * (kind.ndim - 1)]
        return cgutils.get_item_pointer(context, builder, kind, array_, indices)

    return result(array, row), codegen


@intrinsic
def load(typingctx, row, column):  # type: ignore[no-untyped-def]
    """Elements ``column`` to ``column + 7`` of a row of float32 or int32."""
    result = FLOATS if row.dtype == types.float32 else INTS

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, ...]) -> Value:
        return builder.load(_place(builder, result, arguments), align=4)

    return result(row, column), codegen


@intrinsic
def store(typingctx, row, column, value):  # type: ignore[no-untyped-def]
    """Write ``value`` to elements ``column`` to ``column + 7`` of a row."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, ...]) -> Value:
        builder.store(arguments[2], _place(builder, value, arguments), align=4)
        return context.get_dummy_value()

    return types.none(row, column, value), codegen


@intrinsic
def load_some(typingctx, row, column, wanted, otherwise):  # type: ignore[no-untyped-def]
    """Like :func:`load` for the ``wanted`` lanes; the others are ``otherwise`` and need not exist."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, ...]) -> Value:
        place = _place(builder, otherwise, arguments)
        name = f"llvm.masked.load.{_NAMES[otherwise]}.p0"
        how = [place, _INT(4), *arguments[2:]]
        return _call(builder, name, _VECTORS[otherwise], how)

    return otherwise(row, column, wanted, otherwise), codegen


@intrinsic
def store_some(typingctx, row, column, wanted, value):  # type: ignore[no-untyped-def]
    """Like :func:`store` for the ``wanted`` lanes; the others are left alone and need not exist."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, ...]) -> Value:
        place = _place(builder, value, arguments)
        name = f"llvm.masked.store.{_NAMES[value]}.p0"
        _call(builder, name, ir.VoidType(), [arguments[3], place, _INT(4), arguments[2]])
        return context.get_dummy_value()

    return types.none(row, column, wanted, value), codegen


def _place(builder: Builder, lanes: Lanes, arguments: tuple[Value, ...]) -> Value:
    """Address of the vector at a row's element, the first two arguments."""
    return builder.bitcast(builder.gep(arguments[0], [arguments[1]]), _VECTORS[lanes].as_pointer())


@intrinsic
def gather(typingctx, row, index, wanted):  # type: ignore[no-untyped-def]
    """Elements ``index`` of a row of float32, of 32-bit integers, or of bytes with three spare ones behind.

    Lanes that are not ``wanted`` give 0, whatever their index is, and cost no memory access.
    """
    result = FLOATS if row.dtype == types.float32 else INTS
    bits = row.dtype.bitwidth
    element = _SINGLE if result is FLOATS else ir.IntType(bits)

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, ...]) -> Value:
        addresses = builder.gep(arguments[0], [arguments[1]], inbounds=True, source_etype=element)
        addresses.type = ir.VectorType(arguments[0].type, LANES)  # the builder knows single addresses only
        nothing = ir.Constant(_VECTORS[result], [0] * LANES)
        how = [addresses, _INT(bits // 8), arguments[2], nothing]
        name = f"llvm.masked.gather.{_NAMES[result]}.v8p0"
        found = _call(builder, name, _VECTORS[result], how)
        if bits == 32:
            return found
        return builder.and_(found, ir.Constant(_VECTORS[INTS], [(1 << bits) - 1] * LANES))

    return result(row, index, wanted), codegen


@intrinsic
def fused(typingctx, a, b, c):  # type: ignore[no-untyped-def]
    """``a * b + c``, rounded once where the processor can."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, ...]) -> Value:
        return _call(builder, "llvm.fmuladd.v8f32", _VECTORS[FLOATS], list(arguments))

    return FLOATS(a, b, c), codegen


@intrinsic
def quotient(typingctx, a, b):  # type: ignore[no-untyped-def]
    """``a / b`` to about 1 ulp: from the processor's estimate of ``1 / b``, where it has one."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, ...]) -> Value:
        return builder.fdiv(*arguments, flags=("fast",))

    return FLOATS(a, b), codegen


@intrinsic
def to_int(typingctx, value):  # type: ignore[no-untyped-def]
    """Floats to integers, towards zero."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value]) -> Value:
        return builder.fptosi(arguments[0], _VECTORS[INTS])

    return INTS(value), codegen


@intrinsic
def to_float(typingctx, value):  # type: ignore[no-untyped-def]
    """Integers to floats."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value]) -> Value:
        return builder.sitofp(arguments[0], _VECTORS[FLOATS])

    return FLOATS(value), codegen


@intrinsic
def where(typingctx, condition, yes, no):  # type: ignore[no-untyped-def]
    """``yes`` where the condition holds, else ``no``."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, ...]) -> Value:
        return builder.select(*arguments)

    return yes(condition, yes, no), codegen


@intrinsic
def leading(typingctx, condition):  # type: ignore[no-untyped-def]
    """How many lanes hold before the first one that does not, 0 to 8, as int32."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value]) -> Value:
        byte = ir.IntType(LANES)
        failing = builder.zext(builder.not_(builder.bitcast(arguments[0], byte)), _INT)
        beyond = builder.or_(failing, _INT(1 << LANES))
        return _call(builder, "llvm.cttz.i32", _INT, [beyond, _BIT(1)])

    return types.int32(condition), codegen


@intrinsic
def flags(typingctx, condition):  # type: ignore[no-untyped-def]
    """The lanes as the bits of an int32, the first lane lowest."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value]) -> Value:
        return builder.zext(builder.bitcast(arguments[0], ir.IntType(LANES)), _INT)

    return types.int32(condition), codegen


@intrinsic
def how_many(typingctx, condition):  # type: ignore[no-untyped-def]
    """In how many lanes the condition holds, as int32."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value]) -> Value:
        lanes = builder.zext(builder.bitcast(arguments[0], ir.IntType(LANES)), _INT)
        return _call(builder, "llvm.ctpop.i32", _INT, [lanes])

    return types.int32(condition), codegen


@intrinsic
def to_bits(typingctx, value):  # type: ignore[no-untyped-def]
    """The bits of floats, as integers."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value]) -> Value:
        return builder.bitcast(arguments[0], _VECTORS[INTS])

    return INTS(value), codegen


@intrinsic
def from_bits(typingctx, value):  # type: ignore[no-untyped-def]
    """The floats of which the integers are the bits."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value]) -> Value:
        return builder.bitcast(arguments[0], _VECTORS[FLOATS])

    return FLOATS(value), codegen


@intrinsic
def shifted_down(typingctx, value, places):  # type: ignore[no-untyped-def]
    """Signed integers divided by two ``places`` times, rounded down."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, Value]) -> Value:
        return builder.ashr(*arguments)

    return INTS(value, places), codegen


@njit(**EXACT)
def first_of(count):
    """The first ``count`` lanes."""
    return ramp() < splat(count)
