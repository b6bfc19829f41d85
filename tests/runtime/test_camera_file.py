"""Camera files: round trip of our format; files of OpenCV, ROS and Kalibr; faulty files."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from runtime.camera_file import read_camera, write_camera
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

MODEL = CameraParameters()
K = np.array([[700.5, 0.0, 655.25], [0.0, 720.25, 340.75], [0.0, 0.0, 1.0]])
D = (-0.3, 0.1, 0.001, -0.002, 0.05)
LENS = replace(
    MODEL, width=1280, height=720, matrix=(700.5, 720.25, 655.25, 340.75),
    distortion="opencv", coefficients=D,
)  # fmt: skip
FISHEYE = replace(LENS, distortion="fisheye", coefficients=(0.1, -0.02, 0.003, -1e-05))
ROS, MESSAGE, KALIBR, ROWS = (
    (Path(__file__).parent / "camera_files" / f"{name}.yaml").read_text()
    for name in ("ros", "message", "kalibr", "rows")
)


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "camera",
    [
        MODEL,
        replace(MODEL, x=1.234567890123, z=0.1 + 0.2, pitch_deg=-1.7, roll_deg=0.5, yaw_deg=2.0),
        replace(LENS, height_std=0.04),
        FISHEYE,
    ],
)
def test_a_written_camera_is_read_back_exactly(tmp_path: Path, camera: CameraParameters) -> None:
    path = tmp_path / "camera.yaml"
    write_camera(path, camera, "a comment\nof two lines")
    assert path.read_text().startswith("# a comment\n# of two lines\nwidth: ")
    assert read_camera(path, replace(MODEL, pitch_deg=9.0, z=3.0, width=5)) == camera


@pytest.mark.parametrize(
    ("suffix", "header"), [("yaml", "%YAML 1.2"), ("yaml", "%YAML:1.0"), ("json", "{")]
)
@pytest.mark.parametrize("name", ["dist_coeffs", "distortion_coefficients"])
def test_files_that_opencv_writes(tmp_path: Path, suffix: str, header: str, name: str) -> None:
    path = tmp_path / f"camera.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 1280)
    storage.write("image_height", 720)
    storage.write("camera_matrix", K)
    storage.write(name, np.array([D]))
    storage.release()
    if header == "%YAML:1.0":  # written by OpenCV before version 5
        path.write_text(path.read_text().replace("%YAML 1.2", header))
    assert path.read_text().startswith(header)
    assert read_camera(path, MODEL) == LENS


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (ROS, LENS),
        (MESSAGE, LENS),
        (ROWS, LENS),
        (KALIBR, FISHEYE),
        (KALIBR.replace("equidistant", "radtan"), replace(FISHEYE, distortion="opencv")),
        (ROS.replace("plumb_bob", "equidistant").replace("cols: 5", "cols: 4")
         .replace(", 0.05]", "]"), replace(LENS, distortion="fisheye", coefficients=D[:4])),
        (ROWS.replace("[-0.3, 0.1, 0.001, -0.002, 0.05]", "[0, 0, 0, 0, 0]"),
         replace(LENS, distortion="none", coefficients=())),
        (ROWS.replace("0.05]", "0.05, 0.1, 0.2, 0.3, 0, 0, 0, 0]"),
         replace(LENS, coefficients=(*D, 0.1, 0.2, 0.3))),
        (ROS + "height_above_road_m: 1.5\nyaw_deg: -2\n", replace(LENS, z=1.25, yaw_deg=-2)),
        (KALIBR + "pitch_deg: 3\nx: 1.5\n", replace(FISHEYE, pitch_deg=3, x=1.5)),
        # Numbers that YAML reads as text.
        ("x: .5e0\nz: '.5'\npitch_deg: '-.5e0'\nyaw_deg: 1e-05\n",
         replace(MODEL, x=0.5, z=0.5, pitch_deg=-0.5, yaw_deg=1e-05)),
        # A file of an older version, without `matrix`.
        ("width: 640\nheight: 360\nfov_y_deg: 40\nz: 1.25\npitch_deg: 1\n",
         CameraParameters(640, 360, 40.0, z=1.25, pitch_deg=1.0)),
    ],
)  # fmt: skip
def test_files_of_other_programs(tmp_path: Path, text: str, expected: CameraParameters) -> None:
    assert read_camera(written(tmp_path / "camera.yaml", text), MODEL) == expected


def test_what_is_chosen_or_assumed_is_said(tmp_path: Path) -> None:
    lines: list[str] = []
    read_camera(written(tmp_path / "chain.yaml", KALIBR), MODEL, lines.append)
    read_camera(written(tmp_path / "ros.yaml", ROS + "pitch_deg: 2\n"), MODEL, lines.append)
    read_camera(written(tmp_path / "ours.yaml", "fov_y_deg: 60\n"), MODEL, lines.append)
    assert len(lines) == 2
    assert (
        "chain.yaml: cam0 of cam0, cam1 of a Kalibr camchain; no mount is given, so 1.2 m"
        in lines[0]
    )
    assert "ros.yaml: a calibration of OpenCV or ROS; the camera is 1280x720" in lines[1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ROS.replace("[700.5, 0., 655.25, 0., 720.25, 340.75, 0., 0., 1.]", "[]"),
         "camera_matrix has 0 numbers; its rows and cols make 9"),
        ("camera_matrix:\ndist_coeffs: [0, 0, 0, 0]\n", "camera_matrix is None; give a list"),
        ("camera_matrix: {rows: 3, cols: 3}\n", "camera_matrix has no data"),
        (ROS.replace("720.25, 340.75, 0., 0., 1.]", "0., 340.75, 0., 0., 1.]"),
         "camera_matrix is singular"),
        (ROS.replace("[700.5, 0., 655.25", "[700.5, 90., 655.25"), "is not \\[\\[fx, 0, cx\\]"),
        (ROS.replace("[700.5, 0., 655.25", "[-700.5, 0., 655.25"), "must be above 0"),
        (ROS.replace("cols: 5", "cols: 2").replace("0.1, 0.001, -0.002, ", ""),
         "opencv distortion of a camera has 2 numbers; give 4 or 5 or 8 numbers"),
        (ROS.replace("0.05]", ".nan]"), "distortion_coefficients holds nan; give finite"),
        (ROS.replace("0.05]", ".Inf]"), "distortion_coefficients holds inf; give finite"),
        (ROS.replace("0.05]", "five]"), "distortion_coefficients is 'five'; give a number"),
        (ROS.replace("image_width: 1280\n", ""), "no image size; give width and height"),
        (ROS.replace("image_width: 1280\n", "image_width: 1280.5\n"), "whole number of pixels"),
        (ROS.replace("plumb_bob", "double_sphere"), "distortion model is 'double_sphere'"),
        (ROS[: ROS.index("distortion_model")], "no distortion_coefficients; give them, zeros"),
        (KALIBR.replace("pinhole", "omni", 1), "cam0's camera_model is 'omni'; calibrate with"),
        (KALIBR.replace("  resolution: [1280, 720]\n", ""), "cam0 has no resolution"),
        (KALIBR.replace("[1280, 720]", "[1280]"), "resolution has 1 numbers; give width"),
        (KALIBR.replace("[700.5, 720.25, ", "["), "matrix of a camera has 2 numbers; give 4"),
        ("cam0: 3\n", "camera_model is 3"),
        ("matrix: [700, 700, 640, 360]\n", "of an unknown size; give width and height"),
        ("width: 640\nheight: 360\nmatrix: [700, 0, 640, 360]\n", "singular"),
        ("distortion: fisheye\ncoefficients: [1, 2]\n", "has 2 numbers; give 4"),
        ("distortion: [1]\n", "distortion is \\[1\\]; give one of none"),
        ("", "describes no camera"),
        ("- 3", "describes no camera"),
        ("fov_y_deg: [", "cannot be read as a camera"),
        ("fov: 60", "key 'fov' is unknown; known keys are width"),
        ("fov_y_deg: wide", "fov_y_deg is 'wide'; give a number"),
        ("fov_y_deg: 170", "vertical field of view 170 deg"),
        ("z: 1.0\nheight_above_road_m: 1.2", "has both z and height_above_road_m"),
        ("height_above_road_m: 0", "is impossible; give size and height above 0"),
        ("z: .nan", "is impossible"),
        ("x: .inf", "is impossible"),
        ("pitch_deg: 40", "pitch_deg is 40; give -30 to 30"),
        ("height_std: 2\n", "height_std is 2"),
        ("yaw_deg: 200\n", "yaw_deg is 200; give -180 to 180"),
        ("roll_deg: .nan\n", "roll_deg is nan"),
        ("roll_deg: .Nan\n", "roll_deg is nan"),  # text in YAML
        ("x: ..5\n", "x is '..5'; give a number"),
        ("width: .inf\n", "width is inf; give a whole number of pixels"),
        ("height: .nan\n", "height is nan; give a whole number of pixels"),
        (ROS.replace("image_width: 1280", "image_width: .inf"), "image_width is inf; give a whole"),
        (f"x: 1{'0' * 400}\n", "x is 1000.*; give a number below 1e308"),
        (ROS.replace("0.05]", f"1{'0' * 400}]"), "give a number below 1e308"),
        ("%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix 3\n", "not a mapping"),
        ("%YAML:1.0\n---\ncamera_matrix: !!python/object:os.system {}\n", "could not determine"),
    ],
)  # fmt: skip
def test_a_faulty_file_is_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        read_camera(written(tmp_path / "camera.yaml", text), MODEL)
    assert str(caught.value).startswith(str(tmp_path / "camera.yaml"))
    assert "\n" not in str(caught.value)


def test_no_text_at_all_is_a_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_bytes(b"\xff\xfe\x00width")
    with pytest.raises(UserError, match="cannot be read as a camera"):
        read_camera(path, MODEL)
    with pytest.raises(UserError, match=r"none.yaml cannot be read as a camera: No such file"):
        read_camera(tmp_path / "none.yaml", MODEL)
