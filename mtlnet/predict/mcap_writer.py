"""Writes predictions as an MCAP file for Foxglove: pictures, markings drawn over them, features.

    /camera/front               foxglove.CompressedImage: the picture in the model's view
    /camera/front/calibration   foxglove.CameraCalibration of that view, whenever the view changes
    /camera/front/annotations   foxglove.ImageAnnotations: the predicted markings, and the features
    /features                   driverview.Prediction, JSON: the columns of a table of `predict`

Absent features are left out of `/features`. A layout for Foxglove is written next to the file.
"""

import json
from importlib.resources import files
from pathlib import Path
from typing import Any, Self

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType
from mcap.writer import Writer as Mcap

import trackfeatures as tf
from datagen.recording.images import encode
from datagen.recording.schema import messages, topics
from datagen.recording.schema.polylines import CORNER_PX
from mtlnet.inference.overlay import PREDICTION_COLOUR, Distances, marking_line
from mtlnet.inference.prediction import ROAD_CLASSES, Prediction
from mtlnet.predict.writers import feature_lines, table_row, view_of
from mtlnet.sources.read import SourceImage
from trackfeatures.camera import CameraParameters

LAYOUT = "foxglove_layout.json"
TOPICS = (topics.CAMERA, topics.CALIBRATION, topics.ANNOTATIONS)
FEATURES = "/features"
SCHEMA = "driverview.Prediction"
CODEC = "jpeg"
SINCE_1970_S = 1e8
"""A time above this limit, s, is a time since 1970 (recordings, streams); a smaller time is a time
since the start of a film or round."""
CHUNK_BYTES = 1 << 16
"""Size of a chunk, about three images: the loss if the process is killed. Files are 2 % larger than
with chunks of 1 MiB, and take the same time."""
ORANGE = Color(**dict(zip("rgb", (c / 255 for c in PREDICTION_COLOUR), strict=True)), a=1.0)


class McapWriter:
    """Writes each image and its prediction as messages with one log time. Leaving the context
    completes the file."""

    def __init__(self, path: Path, camera: CameraParameters, fps: float) -> None:
        self._path, self._model = path, camera
        self._step_ns = round(topics.NANOSECONDS / fps)
        self._last_ns = self._shift_ns = 0
        self._count = 0
        self._view: CameraParameters | None = None
        self._file = path.open("wb")
        self._mcap = Mcap(self._file, CHUNK_BYTES, CompressionType.ZSTD)
        self._mcap.start(profile="", library="driverview predict")
        self._channels = {name: self._protobuf(name) for name in TOPICS}
        self._channels[FEATURES] = self._mcap.register_channel(
            FEATURES,
            MessageEncoding.JSON,
            self._mcap.register_schema(
                SCHEMA, SchemaEncoding.JSONSchema, json.dumps(features_schema()).encode()
            ),
        )
        layout = files("mtlnet.predict").joinpath(LAYOUT).read_text(encoding="utf-8")
        path.with_suffix(".foxglove.json").write_text(layout, encoding="utf-8")

    def write(self, item: SourceImage, prediction: Prediction) -> None:
        assert item.image is not None
        time = self._log_time(item.time_s)
        stamp = messages.timestamp(time)
        view = view_of(item, self._model)
        if view != self._view:
            self._view = view
            self._add(topics.CALIBRATION, time, messages.calibration(view, stamp))
        image = messages.compressed_image(encode(item.image, CODEC), CODEC, stamp)
        row = {
            name: value for name, value in table_row(item, prediction).items() if value is not None
        }
        self._add(topics.CAMERA, time, image)
        self._add(topics.ANNOTATIONS, time, annotations(item, prediction, view, stamp))
        self._add(FEATURES, time, json.dumps(row).encode())
        self._count += 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._mcap.finish()  # type: ignore[no-untyped-call]  # mcap leaves it untyped
            self._file.close()
        except OSError as error:
            error.filename = str(self._path)
            raise

    def _add(self, topic: str, time: int, data: bytes) -> None:
        try:
            self._mcap.add_message(
                self._channels[topic], time, data, publish_time=time, sequence=self._count
            )
            self._file.flush()
        except OSError as error:
            error.filename = str(self._path)  # missing after a failed write
            raise

    def _log_time(self, time_s: float | None) -> int:
        """Log time in ns since 1970 of an image with the time `time_s`, s. An image without a time
        follows one frame interval after the last image.

        The times of each film and round start at 0; in the file, consecutive films and rounds are
        placed one after another.
        """
        if time_s is None:
            time = self._last_ns + self._step_ns if self._last_ns else topics.EPOCH_NS
        elif time_s > SINCE_1970_S:
            time = round(time_s * topics.NANOSECONDS)
        else:
            time = topics.EPOCH_NS + self._shift_ns + round(time_s * topics.NANOSECONDS)
            if time <= self._last_ns:
                self._shift_ns += self._last_ns + self._step_ns - time
                time = self._last_ns + self._step_ns
        self._last_ns = time
        return time

    def _protobuf(self, topic: str) -> int:
        kind = topics.MESSAGE_TYPES[topic]
        data = topics.schema_data(kind)
        schema = self._mcap.register_schema(
            kind.DESCRIPTOR.full_name, SchemaEncoding.Protobuf, data
        )
        return self._mcap.register_channel(topic, MessageEncoding.Protobuf, schema)


def annotations(
    item: SourceImage, prediction: Prediction, view: CameraParameters, time: Any
) -> bytes:
    """Return the serialised `ImageAnnotations` of an image: predicted markings and a round's labels
    as polylines, and the features as text. Without labels the lines are straight, because the
    curvature is not predicted. `time`: a protobuf Timestamp."""
    message = ImageAnnotations(timestamp=time)
    truth, curvature = item.truth, item.truth.curvature if item.truth else 0.0
    styles: list[tuple[Distances, float, Any]] = [
        (prediction.distances_m, prediction.angle_rad, ORANGE)
    ]
    if truth is not None:
        styles.insert(0, (truth.distances_m, truth.angle_rad, messages.GREEN))
    for distances, angle, colour in styles:
        for distance in distances.values():
            if distance is None:
                continue
            points = marking_line(distance, angle, curvature)
            on_road = np.full(len(points), -CameraParameters.cg_height_m)
            line = message.points.add(type=PointsAnnotation.LINE_STRIP, thickness=1.5)
            line.timestamp.CopyFrom(time)
            line.outline_color.CopyFrom(colour)
            pixels = view.project(np.column_stack([points, on_road])) + CORNER_PX
            for u, v in pixels[np.isfinite(pixels).all(axis=1)].tolist():
                line.points.add(x=u, y=v)
    for row, text in enumerate(feature_lines(prediction)):
        label = message.texts.add(text=text, font_size=9.0)
        label.timestamp.CopyFrom(time)
        label.position.x, label.position.y = 4.0, 12.0 + 12.0 * row
        label.text_color.CopyFrom(messages.WHITE)
        label.background_color.CopyFrom(messages.TEXT_BACKGROUND)
    return bytes(message.SerializeToString())


def features_schema() -> dict[str, Any]:
    """Return the JSON schema of the messages on `/features`, for Foxglove's panels."""
    number = {"type": "number"}
    names = [f"{marking}_m" for marking in tf.MARKINGS]
    names += ["to_lane_centre_m", "angle_rad", *(f"p_{name}" for name in ROAD_CLASSES)]
    names += [f"std_{name}" for name in (*tf.MARKINGS, "to_lane_centre", "angle")]
    names += [f"p_absent_{marking}" for marking in tf.MARKINGS]
    properties: dict[str, Any] = {"image": {"type": "string"}, "time_s": number}
    properties |= dict.fromkeys(names, number)
    properties |= {"out_of_distribution": {"type": "boolean"}}
    return {"title": SCHEMA, "type": "object", "properties": properties}
