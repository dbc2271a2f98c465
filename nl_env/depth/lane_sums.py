"""Eight running sums at a time: what error kernels need beside :mod:`nl_env.lanes`.

A value of type :class:`Sums` holds eight float64; terms are vectors of eight float32. As with lanes, every
operation rounds exactly as written.
"""

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import models, register_model

from nl_env.lanes import FLOATS, LANES, TRUTHS, Builder, Value, intrinsic

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_DOUBLE, _DOUBLES = ir.DoubleType(), ir.VectorType(ir.DoubleType(), LANES)


class Sums(types.Type):  # type: ignore[misc]
    """The type of eight running sums in float64."""

    def __init__(self) -> None:
        super().__init__(name="lane sums")


SUMS = Sums()


@register_model(Sums)
class _SumsModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, sums: Sums) -> None:
        super().__init__(manager, sums, _DOUBLES)


@intrinsic
def zeros(typingctx):  # type: ignore[no-untyped-def]
    """Eight empty sums."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[()]) -> Value:
        return ir.Constant(_DOUBLES, [0.0] * LANES)

    return SUMS(), codegen


@intrinsic
def add(typingctx, sums, terms):  # type: ignore[no-untyped-def]
    """``sums`` with a float32 term more in every lane."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, Value]) -> Value:
        return builder.fadd(arguments[0], builder.fpext(arguments[1], _DOUBLES))

    return SUMS(sums, terms), codegen


@intrinsic
def total(typingctx, sums, last):  # type: ignore[no-untyped-def]
    """The eight ``sums`` as one number: halves added to halves, then the lanes of ``last`` in turn."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, Value]) -> Value:
        halves = arguments[0]
        size = LANES
        while size > 1:
            size //= 2
            order = ir.VectorType(ir.IntType(32), size)
            unused = ir.Constant(halves.type, ir.Undefined)
            lower, upper = (
                builder.shuffle_vector(halves, unused, ir.Constant(order, list(range(first, first + size))))
                for first in (0, size)
            )
            halves = builder.fadd(lower, upper)
        sum_ = builder.extract_element(halves, ir.IntType(32)(0))
        for lane in range(LANES):
            sum_ = builder.fadd(sum_, builder.extract_element(arguments[1], ir.IntType(32)(lane)))
        return sum_

    return types.float64(sums, last), codegen


@intrinsic
def without(typingctx, truths, others):  # type: ignore[no-untyped-def]
    """``truths & ~others``."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, Value]) -> Value:
        return builder.and_(arguments[0], builder.not_(arguments[1]))

    return TRUTHS(truths, others), codegen


@intrinsic
def equal(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Which floats are the same number."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value, Value]) -> Value:
        return builder.fcmp_ordered("==", *arguments)

    return TRUTHS(a, b), codegen


@intrinsic
def sound(typingctx, depths):  # type: ignore[no-untyped-def]
    """Which depths are neither negative nor infinite nor NaN."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value]) -> Value:
        at_least_zero = builder.fcmp_ordered(">=", arguments[0], ir.Constant(_FLOATS, [0.0] * LANES))
        finite = builder.fcmp_ordered("<", arguments[0], ir.Constant(_FLOATS, [math.inf] * LANES))
        return builder.and_(at_least_zero, finite)

    return TRUTHS(depths), codegen


@intrinsic
def magnitude(typingctx, floats):  # type: ignore[no-untyped-def]
    """Absolute values."""

    def codegen(context: Any, builder: Builder, signature: Any, arguments: tuple[Value]) -> Value:
        kind = ir.FunctionType(_FLOATS, [_FLOATS])
        absolute = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fabs.v{LANES}f32")
        return builder.call(absolute, arguments)

    return FLOATS(floats), codegen
