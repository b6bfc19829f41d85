"""Weights as numpy arrays from a safetensors file, without torch or the package of that format.

The file: the header's length (8 bytes, little-endian), the header in JSON (for each tensor its
type, its shape, and where its numbers begin and end), the numbers. Source: the format's own page,
huggingface.co/docs/safetensors.
"""

import json
import math
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.model_card import ModelError

TYPES: dict[str, np.dtype[np.float16 | np.float32]] = {
    "F16": np.dtype("<f2"),
    "F32": np.dtype("<f4"),
}
LENGTH = struct.Struct("<Q")


def read_weights(path: Path) -> dict[str, NDArray[np.float32]]:
    """The tensors of a file by name, in float32; ModelError when it is damaged."""
    content = path.read_bytes()
    try:
        (length,) = LENGTH.unpack_from(content)
        start = LENGTH.size + length
        if start > len(content):
            raise ValueError("its header is cut off")
        header = json.loads(content[LENGTH.size : start])
        header.pop("__metadata__", None)
        return {name: _tensor(content, start, **about) for name, about in header.items()}
    except (struct.error, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ModelError(f"{path} is no whole file of weights ({error}); restore it") from error


def _tensor(
    content: bytes, start: int, dtype: str, shape: list[int], data_offsets: list[int]
) -> NDArray[np.float32]:
    first, last = data_offsets
    kind, count = TYPES[dtype], math.prod(shape)
    if not 0 <= first <= last <= len(content) - start or last - first != count * kind.itemsize:
        raise ValueError(f"{shape} numbers do not lie from {first} to {last}")
    numbers = np.frombuffer(content, kind, count, start + first)
    tensor: NDArray[np.float32] = numbers.reshape(shape).astype(np.float32)
    return tensor
