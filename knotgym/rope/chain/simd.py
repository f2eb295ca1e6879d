"""Several numbers as one, in compiled code: what is written for one rope is done for four at once.

`Lanes` are LANES float64 side by side, a SIMD vector where the processor has one. They stand in
arrays along a last axis of length LANES, `load` and `put` take them out and in. Sums, differences,
products, quotients, `math.sqrt`, `abs`, `min` and `max` go lane by lane, with plain numbers too; so
no lane can tell what the others hold.

After a change run `pytest tests/rope/chain/test_simd.py`: lanes must give the bits of plain
numbers.
"""

import math
import operator
from collections.abc import Callable
from typing import Any, ClassVar

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.typing.templates import AbstractTemplate, Signature, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, register_model

# Numba's own classes, which this module uses, may change with any version; pyproject.toml has the
# same bounds. Tested were 0.61.2 and 0.68.1.
NUMBA = (0, 61), (0, 69)  # the first that works, and the first untried
if not NUMBA[0] <= numba.version_info.short < NUMBA[1]:
    raise ImportError(
        f"the chain engine needs numba from {NUMBA[0][0]}.{NUMBA[0][1]} to before"
        f" {NUMBA[1][0]}.{NUMBA[1][1]}, installed is {numba.__version__}:"
        " pip install 'numba>=0.61,<0.69'"
    )

# Four float64 fill a register of AVX2.
LANES = 4
_VECTOR = ir.VectorType(ir.DoubleType(), LANES)
_ITEM = 8  # bytes that an array's numbers are aligned to


class Lanes(types.Type):
    """The type that Numba knows them by."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


# The only instance: to Numba types are equal if their names are.
_LANES = Lanes()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, type_: Lanes) -> None:
        super().__init__(manager, type_, _VECTOR)


@lower_cast(types.Float, Lanes)
@lower_cast(types.Integer, Lanes)
def _spread(context: Any, builder: Any, given: Any, to: Any, value: Any) -> Any:
    """The same number in every lane."""
    value = context.cast(builder, value, given, types.float64)
    # Inserted one by one; LLVM makes a single broadcast of it.
    vector = ir.Constant(_VECTOR, ir.Undefined)
    for lane in range(LANES):
        vector = builder.insert_element(vector, value, ir.Constant(ir.IntType(32), lane))
    return vector


class _LaneByLane(AbstractTemplate):
    """Lanes and numbers in, lanes out."""

    # asked before the general templates, of which operators have dozens
    metadata: ClassVar = {"target": "cpu"}

    # Numba asks for the type of the result. One argument that is `Lanes` makes all of them lanes;
    # otherwise the answer None leaves plain numbers to Numba's own templates.
    def generic(self, args: Any, kws: Any) -> Signature | None:
        if _LANES in args and all(isinstance(arg, Lanes | types.Number) for arg in args):
            return signature(_LANES, *[_LANES] * len(args))
        return None


def _teach(function: Any, arguments: int, emit: Callable[..., Any]) -> None:
    """Let Numba apply a function to lanes."""
    # Numba asks templates for the result's type, then looks for code by the types of the
    # arguments, plain numbers cast to lanes by `_spread`.
    # A class for each function, as Numba hangs the function on the class that it registers.
    infer_global(function)(type("_LaneByLane", (_LaneByLane,), {}))

    def _lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, *args)

    lower_builtin(function, *[Lanes] * arguments)(_lower)


def _of_one(name: str) -> Callable[..., Any]:
    """A function of LLVM's that takes lanes."""

    def _emit(builder: Any, value: Any) -> Any:
        kind = ir.FunctionType(_VECTOR, [_VECTOR])
        # LLVM's vector intrinsics, such as llvm.sqrt.v4f64; one instruction where there is one.
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f64")
        return builder.call(function, [value])

    return _emit


def _larger(builder: Any, one: Any, other: Any) -> Any:
    # An ordered comparison is false at a NaN, so `one` stays, in every lane by itself.
    return builder.select(builder.fcmp_ordered(">", other, one), other, one)


def _smaller(builder: Any, one: Any, other: Any) -> Any:
    # the same with the comparison turned round, so that a NaN is passed over here, too
    return builder.select(builder.fcmp_ordered("<", other, one), other, one)


for _function, _emit in (
    (operator.add, ir.IRBuilder.fadd),
    (operator.iadd, ir.IRBuilder.fadd),
    (operator.sub, ir.IRBuilder.fsub),
    (operator.isub, ir.IRBuilder.fsub),
    (operator.mul, ir.IRBuilder.fmul),
    (operator.imul, ir.IRBuilder.fmul),
    (operator.truediv, ir.IRBuilder.fdiv),
    (max, _larger),
    (min, _smaller),
):
    _teach(_function, 2, _emit)
_teach(operator.neg, 1, ir.IRBuilder.fneg)
_teach(math.sqrt, 1, _of_one("sqrt"))
_teach(abs, 1, _of_one("fabs"))


def _pointer(context: Any, builder: Any, type_: Any, array: Any, place: Any) -> Any:
    # An array in compiled code is a structure of pointer, shape and strides.
    made = context.make_array(type_)(context, builder, array)
    # The address of lane 0 at the place; the other lanes follow it in memory.
    indices = [*cgutils.unpack_tuple(builder, place), ir.Constant(ir.IntType(64), 0)]
    start = cgutils.get_item_pointer(context, builder, type_, made, indices)
    return builder.bitcast(start, _VECTOR.as_pointer())


def _at(array: Any, place: Any) -> Any:
    """The type of a place in an array of lanes: every index but the last, as int64."""
    if not isinstance(place, types.BaseTuple) or len(place) != array.ndim - 1:
        return None
    return types.UniTuple(types.int64, len(place))


@intrinsic
def load(typing: Any, array: Any, place: Any) -> Any:
    """The lanes at `array[place]`, a place being a tuple of indices, none of them negative."""

    def _emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, sig.args[0], *args)
        # Arrays of NumPy are aligned to one number only, not to a vector.
        return builder.load(pointer, align=_ITEM)

    return _LANES(array, _at(array, place)), _emit


@intrinsic
def put(typing: Any, array: Any, place: Any, value: Any) -> Any:
    """Write lanes, or one number into all of them, to `array[place]`."""

    def _emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, sig.args[0], *args[:2])
        # The value is `Lanes` already: a plain number was cast by `_spread`.
        builder.store(args[2], pointer, align=_ITEM)
        return context.get_dummy_value()

    return types.void(array, _at(array, place), _LANES), _emit


@intrinsic
def fma(typing: Any, one: Any, other: Any, added: Any) -> Any:
    """Return one * other + added, rounded once: the same on every processor."""

    def _emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
        # LLVM promises one rounding, and calls a function of libm where a processor has no such
        # instruction: slower there, with the same bits.
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fma.v{LANES}f64")
        return builder.call(function, args)

    return _LANES(_LANES, _LANES, _LANES), _emit


@intrinsic
def where_below(typing: Any, value: Any, bound: Any, below: Any, otherwise: Any) -> Any:
    """Take lanes of `below` where value < bound, of `otherwise` elsewhere (also at a NaN)."""

    def _emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", args[0], args[1]), args[2], args[3])

    return _LANES(_LANES, _LANES, _LANES, _LANES), _emit


@intrinsic
def any_below(typing: Any, value: Any, bound: Any) -> Any:
    """Whether some lane is less than a number."""

    def _emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        below = builder.fcmp_ordered("<", args[0], args[1])
        # A vector of LANES booleans read as an integer of as many bits.
        bits = builder.bitcast(below, ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(_LANES, _LANES), _emit


@intrinsic
def count_up(typing: Any, count: Any) -> Any:
    """Return the number in an array int64 (1,), and add 1 to it, both at once for all threads."""

    def _emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        held = context.make_array(sig.args[0])(context, builder, args[0])
        unit = ir.Constant(ir.IntType(64), 1)
        return builder.atomic_rmw("add", held.data, unit, "monotonic")

    return types.int64(count), _emit
