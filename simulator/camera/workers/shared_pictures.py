"""Stores the pictures of many cars in one anonymous shared memory.

The memory belongs to a file descriptor that child processes inherit. The kernel frees it when no
process has it open or mapped any more, however the processes end.
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
    """Shape and dtype of one car's picture of one view."""

    shape: tuple[int, ...]
    dtype: str


def create_memory(cars: int, formats: dict[str, PictureFormat]) -> int:
    """Create zeroed memory for the pictures of `cars` cars. `formats` contains the format of a
    car's picture of each view, by the view's name. Returns the memory's file descriptor, which the
    caller must close."""
    descriptor = os.memfd_create("driverview-pictures")
    os.ftruncate(descriptor, sum(_size_bytes(cars, each) for each in formats.values()))
    return descriptor


def map_pictures(
    descriptor: int, cars: int, formats: dict[str, PictureFormat]
) -> dict[str, NDArray[Any]]:
    """Map the memory of the file `descriptor`; returns the pictures (cars, *shape) of each view in
    `formats`. They stay valid after the descriptor is closed."""
    memory = mmap.mmap(descriptor, 0)
    pictures, begin = {}, 0
    for view, each in formats.items():
        shape = (cars, *each.shape)
        flat = np.frombuffer(memory, each.dtype, prod(shape), begin)
        pictures[view] = flat.reshape(shape)
        begin += _size_bytes(cars, each)
    return pictures


def _size_bytes(cars: int, each: PictureFormat) -> int:
    """Return the size in bytes of `cars` pictures with the format `each`, rounded up to whole pages
    of memory."""
    size = cars * prod(each.shape) * np.dtype(each.dtype).itemsize
    return -(-size // PAGE_BYTES) * PAGE_BYTES
