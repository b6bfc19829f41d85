"""Memory of batches is lent again when nobody refers to it, and never before."""

import gc

import torch

from mtlnet.data.loader import BufferPool


def test_memory_is_used_again() -> None:
    memory = BufferPool((2, 3, 4, 3))
    first, second = memory.take(), memory.take()
    places = {first.ctypes.data, second.ctypes.data}
    assert first.shape == (2, 3, 4, 3)
    assert len(places) == 2
    del first, second
    gc.collect()
    again = [memory.take(), memory.take()]
    assert {array.ctypes.data for array in again} == places
    assert memory.take().ctypes.data not in places


def test_memory_with_a_view_or_a_tensor_is_not() -> None:
    memory = BufferPool((4, 5))
    for view_of in (lambda array: array[1:2, ::2], torch.from_numpy):
        array = memory.take()
        array[:] = 7
        view = view_of(array)
        del array
        gc.collect()
        memory.take()[:] = 9
        assert (view == 7).all()
