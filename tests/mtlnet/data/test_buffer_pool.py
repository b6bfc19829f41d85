"""The memory of a batch is reused only when nothing refers to it any more."""

import gc

import torch

from mtlnet.data.loader import BufferPool


def test_freed_memory_is_reused() -> None:
    pool = BufferPool((2, 3, 4, 3))
    first, second = pool.take(), pool.take()
    addresses = {first.ctypes.data, second.ctypes.data}
    assert first.shape == (2, 3, 4, 3)
    assert len(addresses) == 2
    del first, second
    gc.collect()
    again = [pool.take(), pool.take()]
    assert {array.ctypes.data for array in again} == addresses
    assert pool.take().ctypes.data not in addresses


def test_memory_with_a_view_or_a_tensor_is_not_reused() -> None:
    pool = BufferPool((4, 5))
    for view_of in (lambda array: array[1:2, ::2], torch.from_numpy):
        array = pool.take()
        array[:] = 7
        view = view_of(array)
        del array
        gc.collect()
        pool.take()[:] = 9
        assert (view == 7).all()
