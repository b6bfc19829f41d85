"""Memory for batches that is used again: a new one costs a page fault every 4 KB."""

import ctypes
import weakref

import numpy as np
from numpy.typing import NDArray


class Recycled:
    """uint8 arrays of one shape; the memory of one that nobody refers to any more is lent again.

    There are never more than were in use at the same time.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._shape = shape
        self._kind = ctypes.c_ubyte * int(np.prod(shape))
        self._free: list[NDArray[np.uint8]] = []

    def take(self) -> NDArray[np.uint8]:
        """An array; what it holds is anything."""
        try:
            memory = self._free.pop()
        except IndexError:
            memory = np.empty(ctypes.sizeof(self._kind), np.uint8)
        # Every view of the array keeps this alive, whatever becomes of the array itself.
        lent = self._kind.from_buffer(memory.data)
        weakref.finalize(lent, self._free.append, memory).atexit = False
        array: NDArray[np.uint8] = np.frombuffer(memoryview(lent), np.uint8).reshape(self._shape)
        return array
