"""The pictures of many cars in one shared memory without a name.

The memory is that of a file descriptor, which child processes inherit. The kernel frees it with the
last process that has it open or mapped, however that process ends.
"""

import mmap
import os
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

PAGE_BYTES = mmap.PAGESIZE


@dataclass(frozen=True)
class PictureFormat:
    """Shape and number type of one car's picture of one view."""

    shape: tuple[int, ...]
    dtype: str


def create_memory(cars: int, formats: dict[str, PictureFormat]) -> int:
    """The descriptor of new, zeroed memory for the pictures of `cars` cars; close it after use."""
    descriptor = os.memfd_create("driverview-pictures")
    os.ftruncate(descriptor, sum(_size_bytes(cars, each) for each in formats.values()))
    return descriptor


def map_pictures(
    descriptor: int, cars: int, formats: dict[str, PictureFormat]
) -> dict[str, NDArray[Any]]:
    """For each view its pictures (cars, *shape) in the memory; they stay valid when the descriptor
    is closed."""
    memory = mmap.mmap(descriptor, 0)
    pictures, begin = {}, 0
    for view, each in formats.items():
        shape = (cars, *each.shape)
        flat = np.frombuffer(memory, each.dtype, prod(shape), begin)
        pictures[view] = flat.reshape(shape)
        begin += _size_bytes(cars, each)
    return pictures


def _size_bytes(cars: int, each: PictureFormat) -> int:
    """Room for the pictures of one view, in whole pages."""
    size = cars * prod(each.shape) * np.dtype(each.dtype).itemsize
    return -(-size // PAGE_BYTES) * PAGE_BYTES
