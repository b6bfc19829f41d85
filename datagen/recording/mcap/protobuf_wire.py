"""Protobuf wire format, for two cases in which protobuf's library is slow: reading one field of a
message, and writing many points.

Source: protobuf.dev/programming-guides/encoding.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

# A field of type foxglove.Point2: two doubles, fields 1 and 2.
POINT2 = np.dtype(
    [("tag", "u1"), ("length", "u1"), ("x_tag", "u1"), ("x", "<f8"), ("y_tag", "u1"), ("y", "<f8")]
)
DOUBLE_TAG_1, DOUBLE_TAG_2 = 1 << 3 | 1, 2 << 3 | 1


def bytes_field(message: memoryview, number: int) -> memoryview:
    """Return the content of the first length-delimited field with number `number` in `message`.
    Raises ValueError if there is none."""
    for start, end in bytes_fields(message, number):
        return message[start:end]
    raise ValueError(f"the message is damaged: field {number} was not found")


def bytes_fields(message: memoryview, number: int) -> Iterator[tuple[int, int]]:
    """Yield start and end (bytes) of each length-delimited field with number `number`, in order.

    Raises ValueError for a truncated message.
    """
    at, end = 0, len(message)
    while at < end:
        tag, at = _varint(message, at)
        wire_type = tag & 7
        if wire_type == 2:
            length, at = _varint(message, at)
            if at + length > end:
                break
            if tag >> 3 == number:
                yield at, at + length
            at += length
        elif wire_type == 0:
            _, at = _varint(message, at)
        elif wire_type in (1, 5):
            at += 8 if wire_type == 1 else 4
        else:
            break
    if at != end:
        raise ValueError(f"the message is damaged: it breaks off before field {number}")


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    value, shift = 0, 0
    while at < len(message) and shift < 64:
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    raise ValueError("the message is damaged: a varint has no end")


def points_field(number: int, points: ArrayLike) -> bytes:
    """Encode `points` (N, 2) as the repeated field `number` (below 16) of type foxglove.Point2."""
    xy = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    fields = np.empty(len(xy), POINT2)
    fields["tag"], fields["length"] = number << 3 | 2, POINT2.itemsize - 2
    fields["x_tag"], fields["y_tag"] = DOUBLE_TAG_1, DOUBLE_TAG_2
    fields["x"], fields["y"] = xy[:, 0], xy[:, 1]
    return fields.tobytes()
