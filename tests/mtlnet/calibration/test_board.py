"""Calibrations from pictures of boards through known lenses."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mtlnet.calibration.board import NoBoard, calibrate_board
from tests.mtlnet.calibration.drawn import BOARD_PX, board_pictures, chessboard
from trackfeatures.camera import CameraParameters

LENS = CameraParameters(
    480,
    360,
    matrix=(390.0, 393.0, 247.0, 173.0),
    distortion="opencv",
    coefficients=(-0.25, 0.08, 0.001, -0.0007, 0.0),
)
MODEL = CameraParameters()


def test_a_chessboard_gives_the_lens_back(tmp_path: Path) -> None:
    paths = board_pictures(chessboard(7, 5), LENS, tmp_path, 9, seed=1)
    found = calibrate_board(paths, "", MODEL)
    assert found.board == "7x5"
    assert found.used >= 7
    assert found.error_px < 0.15
    assert found.camera.matrix is not None
    assert LENS.matrix is not None
    np.testing.assert_allclose(found.camera.matrix[:2], LENS.matrix[:2], rtol=0.003)
    np.testing.assert_allclose(found.camera.matrix[2:], LENS.matrix[2:], atol=1.5)
    assert found.camera.coefficients[0] == pytest.approx(-0.25, abs=0.02)
    # Corners are compared, because different coefficients can describe the same lens.
    places = np.array([[60.0, 45.0], [420.0, 45.0], [247.0, 173.0], [60.0, 315.0]])
    np.testing.assert_allclose(found.camera.rays(places), LENS.rays(places), atol=0.003)
    assert (found.camera.z, found.camera.pitch_deg) == (MODEL.z, MODEL.pitch_deg)


def test_a_charuco_board_partly_outside_gives_the_lens_back(tmp_path: Path) -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    printed = cv2.aruco.CharucoBoard((7, 5), 1.0, 0.7, dictionary)
    texture = printed.generateImage((9 * BOARD_PX, 7 * BOARD_PX), marginSize=BOARD_PX)
    paths = board_pictures(np.asarray(texture, np.uint8), LENS, tmp_path, 9, seed=2)
    found = calibrate_board(paths, "charuco:7x5:5X5_100:0.7", MODEL)
    assert found.used >= 7
    assert found.camera.matrix is not None
    np.testing.assert_allclose(found.camera.matrix[:2], (390.0, 393.0), rtol=0.003)


def test_a_fisheye_lens(tmp_path: Path) -> None:
    lens = replace(LENS, distortion="fisheye", coefficients=(0.05, -0.02, 0.0, 0.0))
    found = calibrate_board(
        board_pictures(chessboard(7, 5), lens, tmp_path, 9, seed=3), "7x5", MODEL, fisheye=True
    )
    assert found.camera.distortion == "fisheye"
    assert found.camera.matrix is not None
    np.testing.assert_allclose(found.camera.matrix[:2], (390.0, 393.0), rtol=0.003)


def test_pictures_without_a_board_are_named_and_left_out(tmp_path: Path) -> None:
    paths = board_pictures(chessboard(7, 5), LENS, tmp_path, 5, seed=1)
    grey = tmp_path / "grey.png"
    cv2.imwrite(str(grey), np.full((360, 480), 99, np.uint8))
    text = tmp_path / "text.png"
    text.write_text("no picture")
    found = calibrate_board([grey, text, *paths], "7x5", MODEL)
    assert [p.problem for p in found.pictures[:1]] == ["shows no 7x5 board"]
    assert "text.png" in found.pictures[1].problem
    assert all(0 < p.error_px < 0.3 for p in found.pictures[2:] if not p.problem)


@pytest.mark.parametrize(
    ("board", "message"),
    [
        ("", "no chessboard in 2 pictures"),
        ("7x5", "0 of 2 pictures show the board 7x5"),
        ("board", "--board board names no board"),
        ("charuco:7x5:NONE", "OpenCV has no dictionary DICT_NONE"),
        ("charuco:7x5:4X4_50:2", "names no board"),
    ],
)
def test_refusals(tmp_path: Path, board: str, message: str) -> None:
    paths = [tmp_path / "a.png", tmp_path / "b.png"]
    for path in paths:
        cv2.imwrite(str(path), np.full((120, 160), 99, np.uint8))
    with pytest.raises(NoBoard, match=message):
        calibrate_board(paths, board, MODEL)


def test_pictures_of_two_sizes_are_refused(tmp_path: Path) -> None:
    for size in (100, 120):
        cv2.imwrite(str(tmp_path / f"{size}.png"), np.full((size, 160), 99, np.uint8))
    with pytest.raises(NoBoard, match=r"different sizes \(160 x 100, 160 x 120\)"):
        calibrate_board([tmp_path / "100.png", tmp_path / "120.png"], "7x5", MODEL)
