"""The camera that a recording states: choice of the topic, its values, and its use."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mtlnet.api import load
from mtlnet.inference.rectification import Rectification
from mtlnet.predict.run import predict_files
from mtlnet.sources.recordings.cameras import calibration_topic
from mtlnet.sources.recordings.images import CALIBRATION, ROS_CALIBRATION
from mtlnet.sources.recordings.recording import open_recording
from mtlnet.sources.recordings.topic import Topic
from tests.mtlnet.predict.brightness_engine import BrightnessEngine
from tests.mtlnet.sources.recorded import (
    Message,
    ros_camera,
    ros_image,
    write_bag,
    write_foxglove,
)
from tests.typed import typed
from trackfeatures.camera import CameraParameters

SIZE, MATRIX = (560, 420), (400.0, 410.0, 270.0, 200.0)
DISTORTION = (-0.2, 0.05, 0.001, -0.002, 0.01)
IMAGE = np.random.default_rng(1).integers(0, 256, (420, 560, 3), dtype=np.uint8)
MODEL = CameraParameters()
OURS = replace(MODEL, width=560, height=420, matrix=MATRIX)


def bag(folder: Path, camera: dict[str, Any], topic: str = "/cam/image_raw") -> Path:
    messages = [
        (topic, "Image", ros_image(IMAGE, "rgb8")),
        ("/cam/camera_info", "CameraInfo", camera),
    ]
    return write_bag(folder, messages)


@pytest.mark.parametrize(
    ("model", "distortion", "expected"),
    [
        ("plumb_bob", DISTORTION, replace(OURS, distortion="opencv", coefficients=DISTORTION)),
        ("plumb_bob", (0.0,) * 5, OURS),
        ("", (), OURS),
        (
            "rational_polynomial",
            (*DISTORTION, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 0.0),
            replace(OURS, distortion="opencv", coefficients=(*DISTORTION, 0.1, 0.2, 0.3)),
        ),
        (
            "equidistant",
            (0.1, 0.01, 0.0, 0.0),
            replace(OURS, distortion="fisheye", coefficients=(0.1, 0.01, 0.0, 0.0)),
        ),
        (
            "Equidistant",
            (0.0,) * 4,
            replace(OURS, distortion="fisheye", coefficients=(0.0,) * 4),
        ),
    ],
)
def test_a_bag_states_matrix_and_distortion(
    tmp_path: Path, model: str, distortion: tuple[float, ...], expected: CameraParameters
) -> None:
    path = bag(tmp_path / "bag", ros_camera(SIZE, MATRIX, model, distortion))
    found, line = open_recording(path).camera(MODEL)
    assert found == expected
    assert (
        "matrix and distortion come from /cam/camera_info, the mount is the model's (1.2 m above"
        in line
    )


def test_a_region_of_the_full_size_is_no_part(tmp_path: Path) -> None:
    camera = ros_camera(SIZE, MATRIX, "plumb_bob", DISTORTION)
    camera["roi"] = replace(camera["roi"], width=SIZE[0], height=SIZE[1])
    found, _ = open_recording(bag(tmp_path / "bag", camera)).camera(MODEL)
    assert found == replace(OURS, distortion="opencv", coefficients=DISTORTION)


def test_a_rectified_topic_has_the_projection_without_distortion(tmp_path: Path) -> None:
    camera = ros_camera(SIZE, MATRIX, "plumb_bob", DISTORTION, (300.0, 301.0, 280.0, 210.0))
    found, _ = open_recording(bag(tmp_path / "bag", camera, "/cam/image_rect_color")).camera(MODEL)
    assert found == replace(OURS, matrix=(300.0, 301.0, 280.0, 210.0))


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (ros_camera(SIZE, (0.0, 0.0, 0.0, 0.0)), "not calibrated: its matrix K has no focal"),
        (ros_camera(SIZE, MATRIX, "fisheye62", (1.0,)), "model is 'fisheye62'; known"),
        (ros_camera(SIZE, MATRIX, "plumb_bob", (1.0, 2.0)), "has 2 numbers; give 4 or 5 or 8"),
        (ros_camera(SIZE, MATRIX, roi=8), "a part .roi. or are binned"),
    ],
)
def test_a_camera_that_cannot_be_used_is_told(
    engine: BrightnessEngine, tmp_path: Path, camera: dict[str, Any], message: str
) -> None:
    """The model's camera is used, as without a calibration."""
    path = bag(tmp_path / "bag", camera)
    notes: list[str] = []
    rows = predict_files(engine, [str(path)], note=notes.append)
    assert len(rows) == 1
    assert len(notes) == 1
    assert re.search(rf"/cam/camera_info is not used: .*{message}", notes[0])
    assert "give --camera" in notes[0]


def test_pictures_are_taken_by_the_stated_camera_unless_one_is_given(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    """The result is that of the same camera given as a file; a given camera or field of view has
    precedence."""
    camera = ros_camera(SIZE, MATRIX, "plumb_bob", DISTORTION)
    fields = {
        "width": 560, "height": 420, "distortion_model": "plumb_bob", "D": DISTORTION,
        "K": camera["k"].tolist(), "P": camera["p"].tolist(),
    }  # fmt: skip
    raw = {"width": 560, "height": 420, "encoding": "rgb8", "step": 1680, "data": IMAGE.tobytes()}
    front: list[Message] = [
        ("/front", "RawImage", raw), ("/front/calibration", "CameraCalibration", fields)
    ]  # fmt: skip
    lens = Rectification(replace(OURS, distortion="opencv", coefficients=DISTORTION), MODEL)
    expected = np.mean(lens.image(IMAGE)) / 255 - 0.5
    for path in (
        bag(tmp_path / "bag", camera),
        write_foxglove(tmp_path / "a.mcap", front),
        write_foxglove(tmp_path / "b.mcap", front, as_json=True),
    ):
        notes: list[str] = []
        (own,) = predict_files(engine, [str(path)], note=notes.append)
        assert own["angle_rad"] == pytest.approx(expected, abs=2e-3)
        assert len(notes) == 1
        (given,) = predict_files(engine, [str(path)], lens=lens, note=notes.append)
        (wide,) = predict_files(engine, [str(path)], lens=90.0, note=notes.append)
        assert given["angle_rad"] == own["angle_rad"] != wide["angle_rad"]
        assert len(notes) == 1


def test_the_option_camera_model_has_precedence_over_a_stated_camera(
    published: Path, tmp_path: Path
) -> None:
    path = bag(tmp_path / "bag", ros_camera(SIZE, MATRIX, "plumb_bob", DISTORTION))
    cv2.imwrite(str(tmp_path / "a.png"), IMAGE[..., ::-1])
    given = ("mtlnet", "predict", "--model", published, path, "--json")
    own, stated = typed(*given, "--camera", "model"), typed(*given)
    assert "come from /cam/camera_info" in stated.stderr
    assert "camera_info" not in own.stderr
    model = load(published)
    picture = model.predict(tmp_path / "a.png").angle_rad
    (features,) = model.predict(str(path), camera="model")
    assert features.angle_rad == picture == json.loads(own.stdout)[0]["angle_rad"]
    assert json.loads(stated.stdout)[0]["angle_rad"] != picture


@pytest.mark.parametrize(
    ("image", "calibrations", "expected"),
    [
        ("/cam/image_raw/compressed", ["/cam/camera_info"], "/cam/camera_info"),
        (
            "/cam/left/image_raw",
            ["/cam/camera_info", "/cam/left/camera_info"],
            "/cam/left/camera_info",
        ),
        ("/cam/left/image_raw", ["/cam/right/camera_info"], None),
        (
            "/camera/front",
            ["/camera/front/calibration", "/camera/rear/calibration"],
            "/camera/front/calibration",
        ),
        ("/image_raw", ["/camera_info"], "/camera_info"),
        ("/cam/image", ["/cam/info_a", "/cam/info_b"], None),
    ],
)
def test_the_calibration_of_a_topic_is_the_nearest(
    image: str, calibrations: list[str], expected: str | None
) -> None:
    kinds = (ROS_CALIBRATION, CALIBRATION)
    topics = [Topic(name, kinds[n % 2], "cdr") for n, name in enumerate(calibrations)]
    topics.append(Topic("/cam/left/imu", "sensor_msgs/msg/Imu", "cdr"))
    found = calibration_topic(image, topics)
    assert (found and found.name) == expected
