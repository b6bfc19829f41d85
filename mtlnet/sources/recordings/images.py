"""Decodes the picture in one message of a recording, for the image types of Foxglove and ROS 2.

A picture in a file format (JPEG, PNG, ...) gives the same pixels as a file with the same bytes.
"""

import base64
import json
import struct
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.image_decoding.decode import decode_file
from mtlnet.inference.image_decoding.errors import Fault, ImageError
from mtlnet.sources.recordings.raw import decode_raw

Image = NDArray[np.uint8]
NANOSECONDS = 1e9
COMPRESSED, RAW, VIDEO, CALIBRATION = (
    "foxglove.CompressedImage", "foxglove.RawImage", "foxglove.CompressedVideo",
    "foxglove.CameraCalibration",
)  # fmt: skip
ROS_COMPRESSED, ROS_IMAGE, ROS_CALIBRATION = (
    "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo",
)  # fmt: skip
FOXGLOVE = (COMPRESSED, RAW, VIDEO, CALIBRATION)
ROS = (ROS_COMPRESSED, ROS_IMAGE, ROS_CALIBRATION)
ENCODINGS = {**dict.fromkeys(FOXGLOVE, ("protobuf", "json")), **dict.fromkeys(ROS, ("cdr",))}
NO_MESSAGE = (ValueError, TypeError, AttributeError, OverflowError, RecursionError)
"""Exceptions for JSON that is no message, such as an infinite time or 100,000 nested lists."""
IMAGES = (ROS_COMPRESSED, ROS_IMAGE, COMPRESSED, RAW, VIDEO)


def reader_of(schema: str, encoding: str) -> Callable[[bytes], Any] | None:
    """Return a function that parses the bytes of a message of type `schema`; None if this type in
    this encoding is not supported.

    The function returns protobuf messages for Foxglove's types in any encoding, and messages of
    `rosbags` for ROS types. It raises ImageError for damaged bytes.
    """
    if encoding not in ENCODINGS.get(schema, ()):
        return None
    if encoding == "cdr":
        return lambda data: _from_cdr(data, schema)
    return lambda data: (_from_json if encoding == "json" else _from_protobuf)(data, schema)


def time_of(message: Any) -> float:
    """Return the time in the header of a ROS or Foxglove message, s since 1970; 0 if it is not
    set."""
    if hasattr(message, "header"):
        stamp = message.header.stamp
        return float(stamp.sec) + float(stamp.nanosec) / NANOSECONDS
    return float(message.timestamp.seconds) + float(message.timestamp.nanos) / NANOSECONDS


def picture_of(message: Any, schema: str) -> Image:
    """Decode the picture in a message of type `schema`, a type of image from ROS or Foxglove but
    not `CompressedVideo`. Returns uint8 RGB (H, W, 3).

    Raises ImageError for a damaged or unsupported picture.
    """
    if schema == ROS_IMAGE:
        return decode_raw(
            np.asarray(message.data, np.uint8), message.encoding, message.width, message.height,
            message.step, big_endian=bool(message.is_bigendian),
        )  # fmt: skip
    if schema == RAW:
        data = np.frombuffer(message.data, np.uint8)
        return decode_raw(
            data, message.encoding, message.width, message.height, message.step, big_endian=False
        )
    if "compressedDepth" in message.format:
        raise ImageError(
            Fault.UNSUPPORTED, f"its format {message.format!r} holds depths, no picture"
        )
    return decode_file(bytes(message.data))


def _from_protobuf(data: bytes, schema: str) -> Any:
    from google.protobuf.message import DecodeError

    try:
        return _message_type(schema).FromString(data)
    except DecodeError as error:
        raise _damaged(schema, error) from error


def _from_json(data: bytes, schema: str) -> Any:
    """Parse a message in Foxglove's JSON, with bytes in base64 and times as {"sec", "nsec"}."""
    try:
        fields = json.loads(data)
        message = _message_type(schema)()
        stamp = fields.get("timestamp") or {}
        message.timestamp.seconds = int(stamp.get("sec", 0))
        message.timestamp.nanos = int(stamp.get("nsec", stamp.get("nanosec", 0)))
        known = set(message.DESCRIPTOR.fields_by_name) - {"timestamp"}
        for name in known & set(fields):
            value = fields[name]
            if isinstance(value, list):
                getattr(message, name).extend(value)
            else:
                is_bytes = isinstance(getattr(message, name), bytes)
                setattr(message, name, base64.b64decode(value) if is_bytes else value)
        return message
    except NO_MESSAGE as error:
        raise _damaged(schema, error) from error


def _from_cdr(data: bytes, schema: str) -> Any:
    from rosbags.serde import SerdeError

    try:
        return _ros_types().deserialize_cdr(data, schema)
    except (SerdeError, struct.error, ValueError, IndexError, AssertionError, TypeError) as error:
        raise _damaged(schema, error) from error


def _damaged(schema: str, error: Exception) -> ImageError:
    reason = " ".join(str(error).split()) or type(error).__name__
    return ImageError(Fault.DAMAGED, f"the message is not a valid {schema} ({reason})")


@cache
def _ros_types() -> Any:
    """The message types of ROS 2 itself, not the types that a bag declares. The image types are
    equal in all releases."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


@cache
def _message_type(schema: str) -> Any:
    name = schema.removeprefix("foxglove.")
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
