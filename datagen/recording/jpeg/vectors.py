"""Vectors of integers inside compiled functions: the operators of `Vector` write LLVM's code.

numba promotes small integers to 64 bits and leaves it to LLVM to find vectors in loops, which it
does not in a transform of eight rows. Places in arrays are not checked: the callers' are in range
whatever the file holds, and say why.
"""

from collections.abc import Callable, Sequence
from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

I8, I16, I32, I64 = (ir.IntType(bits) for bits in (8, 16, 32, 64))
Intrinsic = Callable[..., Any]
make_intrinsic = cast(Callable[[Callable[..., Any]], Intrinsic], intrinsic)


class Vector:
    """A value of LLVM's vector type; a whole number beside an operator stands for each lane."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder = builder
        self.value = value

    def of(self, other: "Vector | int") -> Any:
        if isinstance(other, Vector):
            return other.value
        kind = self.value.type
        return ir.Constant(kind, [other] * kind.count)

    def _made(self, value: Any) -> "Vector":
        return Vector(self.builder, value)

    def __add__(self, other: "Vector | int") -> "Vector":
        return self._made(self.builder.add(self.value, self.of(other)))

    def __sub__(self, other: "Vector | int") -> "Vector":
        return self._made(self.builder.sub(self.value, self.of(other)))

    def __mul__(self, other: "Vector | int") -> "Vector":
        return self._made(self.builder.mul(self.value, self.of(other)))

    def __or__(self, other: "Vector | int") -> "Vector":
        return self._made(self.builder.or_(self.value, self.of(other)))

    def __and__(self, other: "Vector | int") -> "Vector":
        return self._made(self.builder.and_(self.value, self.of(other)))

    def __lshift__(self, bits: int) -> "Vector":
        return self._made(self.builder.shl(self.value, self.of(bits)))

    def __rshift__(self, bits: int) -> "Vector":
        """The sign is kept."""
        return self._made(self.builder.ashr(self.value, self.of(bits)))

    def unsigned_shift(self, bits: int) -> "Vector":
        return self._made(self.builder.lshr(self.value, self.of(bits)))

    def byte(self) -> "Vector":
        """Each lane, at least 0 and at most 255."""
        low, high = self.of(0), self.of(255)
        builder = self.builder
        value = builder.select(builder.icmp_signed(">", self.value, low), self.value, low)
        return self._made(builder.select(builder.icmp_signed("<", value, high), value, high))

    def to(self, item: Any, *, unsigned: bool = False) -> "Vector":
        """Wider, or cut to, lanes of type `item`."""
        kind = ir.VectorType(item, self.value.type.count)
        if item.width < self.value.type.element.width:
            return self._made(self.builder.trunc(self.value, kind))
        extend = self.builder.zext if unsigned else self.builder.sext
        return self._made(extend(self.value, kind))

    def seen_as(self, item: Any) -> "Vector":
        """The same bits as lanes of another type."""
        kind = self.value.type
        count = kind.count * kind.element.width // item.width
        return self._made(self.builder.bitcast(self.value, ir.VectorType(item, count)))


def zeros(builder: Any, item: Any, count: int) -> Vector:
    return Vector(builder, ir.Constant(ir.VectorType(item, count), [0] * count))


def shuffled(one: Vector, two: Vector, lanes: Sequence[int]) -> Vector:
    """Lanes of `one`, then of `two`, in the order given."""
    mask = ir.Constant(ir.VectorType(I32, len(lanes)), list(lanes))
    return Vector(one.builder, one.builder.shuffle_vector(one.value, two.value, mask))


def load(builder: Any, place: Any, item: Any, count: int) -> Vector:
    value = builder.load(builder.bitcast(place, ir.VectorType(item, count).as_pointer()))
    value.align = 1
    return Vector(builder, value)


def store(place: Any, vector: Vector) -> None:
    builder = vector.builder
    builder.store(vector.value, builder.bitcast(place, vector.value.type.as_pointer())).align = 1


def place_in(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Pointer to `array[index]`, of a one-dimensional array without gaps."""
    return builder.gep(context.make_array(kind)(context, builder, array).data, [index])


def beyond(builder: Any, place: Any, count: int) -> Any:
    return builder.gep(place, [ir.Constant(I64, count)])


@make_intrinsic
def at(typing_context: Any, array: Any, index: Any) -> Any:
    """`array[index]`, unchecked."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(place_in(context, builder, signature.args[0], *arguments))

    return array.dtype(array, types.intp), build


@make_intrinsic
def put(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """`array[index] = value`, unchecked, of which the lowest bits are kept."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        item = context.get_value_type(array.dtype)
        low = arguments[2] if value.bitwidth == item.width else builder.trunc(arguments[2], item)
        builder.store(low, place_in(context, builder, signature.args[0], *arguments[:2]))
        return context.get_dummy_value()

    return types.void(array, types.intp, value), build


@make_intrinsic
def big_endian(typing_context: Any, array: Any, index: Any) -> Any:
    """`array[index : index + 8]`, bytes, as one number; the first is the highest. Unchecked."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = place_in(context, builder, signature.args[0], *arguments)
        value = builder.load(builder.bitcast(place, I64.as_pointer()))
        value.align = 1
        swap = builder.module.declare_intrinsic("llvm.bswap", [I64])
        return builder.call(swap, [value])

    return types.uint64(array, types.intp), build


@make_intrinsic
def copy_eight(typing_context: Any, source: Any, start: Any, target: Any, to: Any) -> Any:
    """`target[to : to + 8] = source[start : start + 8]`, bytes, unchecked."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kinds = signature.args
        eight = load(builder, place_in(context, builder, kinds[0], *arguments[:2]), I8, 8)
        store(place_in(context, builder, kinds[2], *arguments[2:]), eight)
        return context.get_dummy_value()

    return types.void(source, types.intp, target, types.intp), build


@make_intrinsic
def take_next(typing_context: Any, counter: Any) -> Any:
    """`counter[0]`, which is one more afterwards; no two threads get the same."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = place_in(context, builder, signature.args[0], arguments[0], ir.Constant(I64, 0))
        return builder.atomic_rmw("add", place, ir.Constant(I64, 1), "monotonic")

    return types.int64(counter), build


@make_intrinsic
def bytes_from(typing_context: Any, address: Any) -> Any:
    """Pointer to the bytes from `address` of memory; somebody else keeps them there."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], I8.as_pointer())

    pointer: Any = types.CPointer
    return pointer(types.uint8)(types.int64), build
