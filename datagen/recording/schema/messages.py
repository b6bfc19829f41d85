"""Makes protobuf messages of frames: one function per topic returns the serialised message.

World frame: x, y in the plane, z up; SI units, angles in rad, counter-clockwise.
"""

from collections.abc import Mapping
from dataclasses import asdict
from math import asin, atan2, cos, sin
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording.frame import DriverCommand, EgoState, Frame, SensorReadings
from datagen.recording.mcap.protobuf_wire import points_field
from datagen.recording.schema.polylines import CORNER_PX
from datagen.recording.schema.proto.driverview_pb2 import (
    Command,
    Sensors,
    TrackFeatures,
    VehicleState,
)
from datagen.recording.schema.topics import NANOSECONDS
from trackfeatures.camera import CameraParameters

WORLD, EGO, CAMERA_FRAME = "world", "ego", "camera_front"
EGO_SIZE_M = (4.52, 1.94, 1.10)
TRAFFIC_SIZE_M = (4.4, 1.8, 1.4)
EGO_BOX_CENTRE_HEIGHT_M = 0.30  # above the centre of gravity
GREEN = Color(r=0.1, g=1.0, b=0.3, a=1.0)
WHITE = Color(r=1.0, g=1.0, b=1.0, a=1.0)
TEXT_BACKGROUND = Color(r=0.0, g=0.0, b=0.0, a=0.5)
BLUE = Color(r=0.2, g=0.4, b=1.0, a=1.0)
GREY = Color(r=0.7, g=0.7, b=0.7, a=1.0)

Quaternion = tuple[float, float, float, float]


def timestamp(log_time_ns: int) -> Timestamp:
    return Timestamp(seconds=log_time_ns // NANOSECONDS, nanos=log_time_ns % NANOSECONDS)


def compressed_image(data: bytes, codec: str, time: Timestamp) -> bytes:
    return _serialize(
        CompressedImage(timestamp=time, frame_id=CAMERA_FRAME, data=data, format=codec)
    )


def calibration(camera: CameraParameters, time: Timestamp) -> bytes:
    model, coefficients = lens_parameters(camera)
    k = camera.intrinsics()
    projection = np.hstack([k, np.zeros((3, 1))])
    return _serialize(
        CameraCalibration(
            timestamp=time,
            frame_id=CAMERA_FRAME,
            width=camera.width,
            height=camera.height,
            distortion_model=model,
            D=coefficients,
            K=k.ravel().tolist(),
            R=np.eye(3).ravel().tolist(),
            P=projection.ravel().tolist(),
        )
    )


def lens_parameters(camera: CameraParameters) -> tuple[str, list[float]]:
    """Return Foxglove's name of the camera's distortion model, and its coefficients."""
    if camera.distortion == "fisheye":
        return "kannala_brandt", list(camera.coefficients)
    count = 8 if len(camera.coefficients) > 5 else 5
    padded = [*camera.coefficients, *[0.0] * (count - len(camera.coefficients))]
    return "rational_polynomial" if count == 8 else "plumb_bob", padded


def annotations(frame: Frame, time: Timestamp) -> bytes:
    """Return the serialised annotations of an image: the lane markings as polylines (pixels) and a
    line of text with the labels."""
    message = ImageAnnotations(timestamp=time)
    for polyline in frame.markings:
        line = message.points.add()
        line.timestamp.CopyFrom(time)
        line.type = PointsAnnotation.LINE_STRIP
        line.thickness = 1.0
        line.outline_color.CopyFrom(GREEN)
        line.MergeFromString(
            points_field(PointsAnnotation.POINTS_FIELD_NUMBER, polyline + CORNER_PX)
        )
    text = message.texts.add()
    text.timestamp.CopyFrom(time)
    text.position.x, text.position.y = 4.0, 12.0
    text.font_size = 9.0
    text.text = caption(frame.features)
    text.text_color.CopyFrom(WHITE)
    text.background_color.CopyFrom(TEXT_BACKGROUND)
    return _serialize(message)


def caption(features: tf.TrackFeatures) -> str:
    """Return the features in one line of text: the distances in m that are present, the angle in
    rad, and the class of the road."""
    distances = " ".join(
        f"{name} {value:.2f}" for name, value in features.distances.items() if value is not None
    )
    return f"{distances} | {features.angle:+.3f} rad | {features.heading.name.lower()}"


def labels(frame: Frame) -> bytes:
    features = frame.features
    distances: dict[str, Any] = {f"to_marking_{n}": d for n, d in features.distances.items()}
    return _serialize(
        TrackFeatures(
            **distances,
            to_lane_centre=features.to_lane_centre,
            angle=features.angle,
            heading=features.heading.name,
            **asdict(frame.place),
        )
    )


def ego_state(ego: EgoState) -> bytes:
    return _serialize(VehicleState(**asdict(ego)))


def sensors(readings: SensorReadings) -> bytes:
    return _serialize(Sensors(**asdict(readings)))


def command(given: DriverCommand) -> bytes:
    return _serialize(Command(**asdict(given)))


def traffic(frame: Frame, time: Timestamp) -> bytes:
    """Return the serialised boxes of all cars: other cars in the world frame, the ego car in its
    body frame."""
    message = SceneUpdate()
    ego = (0.0, 0.0, EGO_BOX_CENTRE_HEIGHT_M, 0.0, 0.0, 0.0)
    _add_box(message, "ego", EGO, ego, EGO_SIZE_M, BLUE, time)
    for number, (x, y, z, roll, pitch, yaw) in enumerate(frame.traffic.tolist()):
        middle = (x, y, z + TRAFFIC_SIZE_M[2] / 2.0, roll, pitch, yaw)
        _add_box(message, f"car {number}", WORLD, middle, TRAFFIC_SIZE_M, GREY, time)
    return _serialize(message)


def track_scene(lines: Mapping[str, NDArray[np.float64]], time: Timestamp) -> bytes:
    """Return the serialised scene with the named polylines `lines`, each (N, 3) in m in the world
    frame."""
    message = SceneUpdate()
    for name, points in lines.items():
        entity = message.entities.add(id=name, frame_id=WORLD)
        entity.timestamp.CopyFrom(time)
        line = entity.lines.add(type=LinePrimitive.LINE_STRIP, thickness=0.12)
        line.pose.orientation.w = 1.0
        line.color.CopyFrom(WHITE)
        for x, y, z in points.tolist():
            line.points.add(x=x, y=y, z=z)
    return _serialize(message)


def transforms(ego: EgoState, camera: CameraParameters, time: Timestamp) -> bytes:
    """Return two serialised coordinate transforms: the car's pose in the world, and the camera's
    pose on the car."""
    message = FrameTransforms()
    _add_transform(
        message, WORLD, EGO, (ego.x, ego.y, ego.z), quaternion(ego.roll, ego.pitch, ego.yaw), time
    )
    turn = camera.rotation().T  # its columns: x to the right, y down, z along the view
    optical = quaternion(
        atan2(turn[2, 1], turn[2, 2]), -asin(turn[2, 0]), atan2(turn[1, 0], turn[0, 0])
    )
    _add_transform(message, EGO, CAMERA_FRAME, (camera.x, camera.y, camera.z), optical, time)
    return _serialize(message)


def quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the quaternion (x, y, z, w) of the rotation Rz(yaw) Ry(pitch) Rx(roll); angles in
    rad."""
    cr, sr = cos(roll / 2.0), sin(roll / 2.0)
    cp, sp = cos(pitch / 2.0), sin(pitch / 2.0)
    cy, sy = cos(yaw / 2.0), sin(yaw / 2.0)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def _add_box(
    message: Any,
    name: str,
    frame_id: str,
    pose: tuple[float, float, float, float, float, float],
    size: tuple[float, float, float],
    color: Any,
    time: Timestamp,
) -> None:
    x, y, z, roll, pitch, yaw = pose
    entity = message.entities.add(id=name, frame_id=frame_id, frame_locked=frame_id != WORLD)
    entity.timestamp.CopyFrom(time)
    cube = entity.cubes.add()
    place, turn = cube.pose.position, cube.pose.orientation
    place.x, place.y, place.z = x, y, z
    turn.x, turn.y, turn.z, turn.w = quaternion(roll, pitch, yaw)
    cube.size.x, cube.size.y, cube.size.z = size
    cube.color.CopyFrom(color)


def _add_transform(
    message: Any,
    parent: str,
    child: str,
    place: tuple[float, float, float],
    turn: Quaternion,
    time: Timestamp,
) -> None:
    transform = message.transforms.add(parent_frame_id=parent, child_frame_id=child)
    transform.timestamp.CopyFrom(time)
    shift, rotation = transform.translation, transform.rotation
    shift.x, shift.y, shift.z = place
    rotation.x, rotation.y, rotation.z, rotation.w = turn


def _serialize(message: Any) -> bytes:
    return bytes(message.SerializeToString())
