"""Recordings of other programs for tests, made by the official writers `rosbags` and `mcap`."""

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from datagen.recording.schema.topics import schema_data

START_S = 1_700_000_000
STEP_NS = 50_000_000
LOG_DELAY_NS = 7_000_000  # the log time of a message is later than its header's
KINDS = {kind.DESCRIPTOR.full_name: kind for kind in (
    CameraCalibration, CompressedImage, CompressedVideo, RawImage,
)}  # fmt: skip
TYPES = get_typestore(Stores.LATEST).types
Message = tuple[str, str, Any]
"""Topic, message type and fields."""


def stamp(number: int) -> tuple[int, int]:
    """Seconds and nanoseconds in the header of message `number`."""
    total = number * STEP_NS
    return START_S + total // 10**9, total % 10**9


def write_bag(
    folder: Path,
    messages: Sequence[Message],
    storage: StoragePlugin = StoragePlugin.MCAP,
    mode: CompressionMode = CompressionMode.NONE,
) -> Path:
    """A ROS 2 bag; fields of `sensor_msgs/msg/KIND` without the header, one time step per
    message."""
    store = get_typestore(Stores.LATEST)
    writer = BagWriter(folder, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    counts: dict[str, int] = {}
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, fields in messages:
            name = f"sensor_msgs/msg/{kind}"
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            number = counts[topic] = counts.get(topic, -1) + 1
            message = TYPES[name](header=header(number), **fields)
            data = store.serialize_cdr(message, name)
            time = START_S * 10**9 + number * STEP_NS + LOG_DELAY_NS
            writer.write(connections[topic], time, data)
    return folder


def header(number: int) -> Any:
    sec, nanosec = stamp(number)
    time = TYPES["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
    return TYPES["std_msgs/msg/Header"](stamp=time, frame_id="camera")


def ros_compressed(data: bytes, form: str = "jpeg") -> dict[str, Any]:
    return {"format": form, "data": np.frombuffer(data, np.uint8)}


def ros_image(image: NDArray[Any], encoding: str, padding: int = 0) -> dict[str, Any]:
    """`image`: (H, W, ...) of the encoding; `padding`: bytes at the end of each row."""
    rows = image.reshape(len(image), -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    return {
        "height": image.shape[0], "width": image.shape[1], "encoding": encoding,
        "is_bigendian": int(image.dtype.byteorder == ">"), "step": padded.shape[1],
        "data": padded.ravel(),
    }  # fmt: skip


def ros_camera(
    size: tuple[int, int], matrix: Sequence[float], model: str = "plumb_bob",
    distortion: Sequence[float] = (), projection: Sequence[float] = (), roi: int = 0,
) -> dict[str, Any]:  # fmt: skip
    """`size`: width and height; `matrix`: fx, fy, cx, cy, and so `projection`."""
    k, p = (_matrix(values) for values in (matrix, projection or matrix))
    region = TYPES["sensor_msgs/msg/RegionOfInterest"]
    return {
        "width": size[0], "height": size[1], "distortion_model": model,
        "d": np.array(distortion, float), "k": k.ravel(), "r": np.eye(3).ravel(),
        "p": np.hstack([p, np.zeros((3, 1))]).ravel(), "binning_x": 0, "binning_y": 0,
        "roi": region(x_offset=0, y_offset=0, height=roi, width=roi, do_rectify=False),
    }  # fmt: skip


def _matrix(values: Sequence[float]) -> NDArray[np.float64]:
    fx, fy, cx, cy = values
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def write_foxglove(
    path: Path,
    messages: Sequence[Message],
    *,
    as_json: bool = False,
    finish: bool = True,
    chunk_bytes: int = 1 << 20,
) -> Path:
    """A Foxglove file; fields of `foxglove.KIND` without the time, one time step per message. With
    `as_json` the bytes of a whole message can replace its fields."""
    counts: dict[str, int] = {}
    channels: dict[str, int] = {}
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_bytes, compression=CompressionType.LZ4)
        writer.start()
        for topic, kind, fields in messages:
            name, form = f"foxglove.{kind}", "json" if as_json else "protobuf"
            if topic not in channels:
                data = b"{}" if as_json else schema_data(KINDS[name])
                schema = writer.register_schema(name, "jsonschema" if as_json else form, data)
                channels[topic] = writer.register_channel(topic, form, schema)
            number = counts[topic] = counts.get(topic, -1) + 1
            content = _json(number, fields) if as_json else _protobuf(name, number, fields)
            time = START_S * 10**9 + number * STEP_NS + LOG_DELAY_NS
            writer.add_message(channels[topic], time, content, time)
        if finish:
            writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it untyped
    return path


def _json(number: int, fields: dict[str, Any] | bytes) -> bytes:
    if isinstance(fields, bytes):  # the whole message
        return fields
    sec, nsec = stamp(number)
    plain = {
        name: base64.b64encode(value).decode() if isinstance(value, bytes) else value
        for name, value in fields.items()
    }
    return json.dumps({"timestamp": {"sec": sec, "nsec": nsec}, **plain}).encode()


def _protobuf(name: str, number: int, fields: dict[str, Any]) -> bytes:
    sec, nanos = stamp(number)
    message = KINDS[name](timestamp=Timestamp(seconds=sec, nanos=nanos), **fields)
    return bytes(message.SerializeToString())
