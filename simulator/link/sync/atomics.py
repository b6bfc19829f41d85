"""C11 atomic loads, stores and fences on numpy arrays for compiled functions, because numba has
none.

Each function is one LLVM instruction, so it is correct on every processor, also on processors that
reorder memory accesses (ARM). The arrays contain integers and are aligned to their item size.
"""

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

Intrinsic = Callable[..., Any]
get_item_pointer: Callable[..., Any] = cgutils.get_item_pointer


def _place(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Build a pointer to `array[index]`."""
    struct = context.make_array(kind)(context, builder, array)
    return get_item_pointer(context, builder, kind, struct, [index])


def _load(ordering: str) -> Intrinsic:
    """Return a function (array, index) for compiled code that loads an item with this ordering."""

    def typed(typing_context: Any, array: Any, index: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            place = _place(context, builder, signature.args[0], *arguments)
            item = context.get_value_type(array.dtype)
            return builder.load_atomic(place, ordering, array.dtype.bitwidth // 8, typ=item)

        return array.dtype(array, types.intp), build

    return cast(Intrinsic, intrinsic(typed))


def _store(ordering: str) -> Intrinsic:
    """Return a function (array, index, value) that stores an item with this ordering."""

    def typed(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            place = _place(context, builder, signature.args[0], arguments[0], arguments[1])
            builder.store_atomic(arguments[2], place, ordering, array.dtype.bitwidth // 8)
            return context.get_dummy_value()

        return types.void(array, types.intp, array.dtype), build

    return cast(Intrinsic, intrinsic(typed))


def _fence(ordering: str) -> Intrinsic:
    """Return a function for compiled code that is a memory fence with this ordering."""

    def typed(typing_context: Any) -> Any:
        def build(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
            builder.fence(ordering)
            return context.get_dummy_value()

        return types.void(), build

    return cast(Intrinsic, intrinsic(typed))


load_relaxed, load_acquire = _load("monotonic"), _load("acquire")
store_relaxed, store_release = _store("monotonic"), _store("release")
fence_acquire, fence_release = _fence("acquire"), _fence("release")
