"""The recorded camera, lens and mount, is read correctly by OpenCV and scipy."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from google.protobuf.timestamp_pb2 import Timestamp

from datagen.recording.frame import EgoState
from datagen.recording.round_metadata import RoundHeader
from datagen.recording.schema.messages import calibration, transforms
from trackfeatures.camera import CameraParameters

OPENCV = CameraParameters(
    640, 400, x=1.2, y=-0.2, z=1.1, pitch_deg=5.0, roll_deg=-3.0, yaw_deg=12.0,
    matrix=(380.0, 378.0, 325.0, 190.0), distortion="opencv", coefficients=(-0.3, 0.1, 1e-3, -5e-4),
)  # fmt: skip
FISHEYE = replace(OPENCV, distortion="fisheye", coefficients=(-0.02, 0.004, -0.001, 0.0))
RATIONAL = replace(OPENCV, coefficients=(0.9, 0.3, 3e-4, -4e-4, 0.02, 1.2, 0.5, 0.05))
NOW = Timestamp(seconds=1)


@pytest.mark.parametrize(
    ("camera", "model", "count"),
    [
        (CameraParameters(), "plumb_bob", 5),
        (OPENCV, "plumb_bob", 5),
        (RATIONAL, "rational_polynomial", 8),
        (FISHEYE, "kannala_brandt", 4),
    ],
)
def test_calibration_and_mount_project_as_the_camera_does(
    camera: CameraParameters, model: str, count: int
) -> None:
    lens = CameraCalibration.FromString(calibration(camera, NOW))
    assert (lens.distortion_model, len(lens.D)) == (model, count)
    at_rest = EgoState(*[0.0] * len(EgoState.__dataclass_fields__))
    mount = FrameTransforms.FromString(transforms(at_rest, camera, NOW)).transforms[1]
    shift, turn = mount.translation, mount.rotation
    x, y, z, w = turn.x, turn.y, turn.z, turn.w
    to_car = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    points = np.random.default_rng(0).uniform([6, -2, -0.3], [30, 2, 1], (20, 3))
    seen = (points - (shift.x, shift.y, shift.z)) @ to_car
    k, d = np.array(lens.K).reshape(3, 3), np.array(lens.D)
    project = cv2.fisheye.projectPoints if model == "kannala_brandt" else cv2.projectPoints
    pixels, _ = project(seen[:, None], np.zeros(3), np.zeros(3), k, d)
    np.testing.assert_allclose(pixels.reshape(-1, 2), camera.project(points), atol=1e-6)


def test_a_header_of_before_cameras_had_lenses_stays_as_it_is() -> None:
    stored = {
        "width": 280, "height": 210, "fov_y_deg": 67.5, "x": 0.75, "y": 0.0, "z": 0.95,
        "pitch_deg": 0.0,
    }  # fmt: skip
    header = RoundHeader("a", 1, "oval", "0", 1, 4.0, 0, "centre", ("clear",), 50.0)
    metadata = header.to_metadata()
    assert metadata["camera"] == json.dumps(stored)
    assert RoundHeader.from_metadata(metadata) == header
    lens = replace(header, camera=FISHEYE, nominal_camera=OPENCV)
    assert RoundHeader.from_metadata(lens.to_metadata()) == lens
