"""Reads weights from a safetensors file as numpy arrays, without torch or the safetensors package.

Layout of the file: length of the header (8 bytes, little-endian), header in JSON (type, shape,
begin and end of each tensor), data. Source: huggingface.co/docs/safetensors.
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
    """The tensors of a file by name, in float32. Raises ModelError when the file is damaged."""
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
        raise ModelError(f"{path} is not a complete weights file ({error}); restore it") from error


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
