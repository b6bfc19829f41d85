"""Topics of a recording, their message types, and the conversion of steps to log times (ns)."""

from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from numpy.typing import NDArray

from datagen.recording.schema.proto.driverview_pb2 import (
    Command,
    Sensors,
    TrackFeatures,
    VehicleState,
)

CAMERA = "/camera/front"
CALIBRATION = "/camera/front/calibration"
ANNOTATIONS = "/camera/front/annotations"
LABELS = "/labels"
EGO_STATE = "/ego/state"
SENSORS = "/sensors"
COMMAND = "/command"
TRAFFIC = "/traffic"
TRACK_SCENE = "/track/scene"
TRANSFORMS = "/tf"

# The order sets the channel numbers, and so the bytes of every file: never change it.
MESSAGE_TYPES: dict[str, Any] = {
    CAMERA: CompressedImage,
    CALIBRATION: CameraCalibration,
    ANNOTATIONS: ImageAnnotations,
    LABELS: TrackFeatures,
    EGO_STATE: VehicleState,
    SENSORS: Sensors,
    COMMAND: Command,
    TRAFFIC: SceneUpdate,
    TRACK_SCENE: SceneUpdate,
    TRANSFORMS: FrameTransforms,
}
EVERY_STEP = (CAMERA, ANNOTATIONS, LABELS, EGO_STATE, SENSORS, COMMAND, TRAFFIC, TRANSFORMS)

# Log time of simulated time 0: 2020-01-01T00:00:00Z. Viewers expect a date; with a fixed date the
# same round gives the same bytes.
EPOCH_NS = 1_577_836_800_000_000_000
NANOSECONDS = 1_000_000_000


def log_time_ns(step: int, frequency_hz: int) -> int:
    """Return the log time (ns since 1970) of frame `step` (from 0) of a round with `frequency_hz`
    frames/s."""
    return EPOCH_NS + step * NANOSECONDS // frequency_hz


def steps_at(log_times: NDArray[np.int64], frequency_hz: int) -> NDArray[np.int64]:
    """Return the frame numbers (N,) of the log times `log_times` (N,) in ns of a round with
    `frequency_hz` frames/s."""
    steps: NDArray[np.int64] = -(-(log_times - EPOCH_NS) * frequency_hz // NANOSECONDS)
    return steps


def seconds(log_time: int) -> float:
    """Convert a log time (ns) to simulated time since the start of the round (s)."""
    return (log_time - EPOCH_NS) / NANOSECONDS


def schema_data(message_type: Any) -> bytes:
    """Return the serialised FileDescriptorSet that MCAP stores as the schema of the protobuf class
    `message_type`."""
    files: dict[str, FileDescriptor] = {}
    _collect(message_type.DESCRIPTOR.file, files)
    descriptors = FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(descriptors.file.add())
    return bytes(descriptors.SerializeToString(deterministic=True))


def _collect(file: FileDescriptor, files: dict[str, FileDescriptor]) -> None:
    """Add `file` to `files`, after its dependencies and unless it is already there."""
    if file.name in files:
        return
    for dependency in file.dependencies:
        _collect(dependency, files)
    files[file.name] = file
