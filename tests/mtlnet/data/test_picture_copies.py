"""Copies of a labelled picture: painted points lie where the labels of the copies say."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mtlnet.data.labels_file import read_labels
from mtlnet.data.picture_copies import (
    COPIES,
    TURNS_RAD,
    copied_camera,
    copied_label,
    copied_picture,
    turned_camera,
)
from trackfeatures.camera import CameraParameters

LABELS = "file,ml,mr,l,m,r,angle,heading\na.png,-1.5,2.5,,,,0.02,straight\n"


def test_copies_show_what_their_labels_say(tmp_path: Path) -> None:
    """A painted point of the road lies in each copy at the place that the copy's camera and label
    give."""
    camera = CameraParameters(width=641, height=361, fov_y_deg=40, x=0.5, y=0.2, z=1.0, pitch_deg=2)
    (tmp_path / "labels.csv").write_text(LABELS)
    _, labels = read_labels(tmp_path / "labels.csv")
    for copy in COPIES:
        distances, angle, _ = copied_label(labels, 0, camera, copy)
        moved = copied_camera(camera, copy)
        # A point of the left marking, 12 m ahead of the camera along the road.
        marking = {"mirrored": 1}.get(copy, 0)
        original = _marking_pixel(camera, -1.5, 0.02, 12.0)
        image = np.zeros((361, 641, 3), np.uint8)
        u, v = np.round(original).astype(int)
        cv2.circle(image, (int(u), int(v)), 3, (255, 255, 255), -1)
        shown = np.argwhere(copied_picture(image, camera, copy)[..., 0] > 128).mean(0)[::-1]
        expected = _marking_pixel(moved, float(distances[0, marking]), float(angle[0]), 12.0)
        np.testing.assert_allclose(shown, expected, atol=1.5, err_msg=copy)


TILTED = CameraParameters(
    641, 361, fov_y_deg=40, x=0.5, y=0.2, z=1.0, pitch_deg=5, roll_deg=-5, yaw_deg=2
)
LENSES = {
    "none": TILTED,
    "opencv": replace(TILTED, distortion="opencv", coefficients=(-0.1, 0.02, 1e-3, -1e-3)),
    "fisheye": replace(TILTED, distortion="fisheye", coefficients=(0.02, -0.01, 0.0, 0.0)),
}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("copy", TURNS_RAD)
def test_turned_copies_of_a_tilted_camera_show_their_labels(
    tmp_path: Path, lens: str, copy: str
) -> None:
    """Spots on both markings lie in the copy where its label and camera give them."""
    camera = LENSES[lens]
    (tmp_path / "labels.csv").write_text(LABELS)
    _, labels = read_labels(tmp_path / "labels.csv")
    turned, (angle,), _ = copied_label(labels, 0, camera, copy)
    columns, rows = np.meshgrid(np.arange(641), np.arange(361))
    for side, along in ((0, 8.0), (0, 12.0), (1, 12.0), (1, 20.0)):
        before = _marking_pixel(camera, float(labels.distances[0, side]), 0.02, along)
        after = _marking_pixel(camera, float(turned[0, side]), float(angle), along)
        spot = 255 * np.exp(-((columns - before[0]) ** 2 + (rows - before[1]) ** 2) / 18)
        image = np.repeat(np.round(spot)[..., None], 3, axis=2).astype(np.uint8)
        shown = copied_picture(image, camera, copy)[..., 0].astype(float)
        shown[np.hypot(columns - after[0], rows - after[1]) > 15] = 0  # the grey border
        found = np.array([(shown * columns).sum(), (shown * rows).sum()]) / shown.sum()
        np.testing.assert_allclose(found, after, atol=0.1)
        if lens == "none":
            way = camera.homography(turned_camera(camera, copy)) @ (*before, 1.0)
            np.testing.assert_allclose(way[:2] / way[2], after, atol=1e-5)  # float32 labels


@pytest.mark.parametrize("copy", TURNS_RAD)
def test_turned_copies_of_a_level_camera_are_those_of_its_own_axis(copy: str) -> None:
    """Without roll and pitch the vertical axis of the camera is the vertical axis of the car."""
    camera = CameraParameters(280, 210, yaw_deg=3.0)
    image = np.random.default_rng(0).integers(0, 256, (210, 280, 3), dtype=np.uint8)
    cosine, sine = np.cos(TURNS_RAD[copy]), np.sin(TURNS_RAD[copy])
    k = camera.intrinsics()
    way = k @ np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]) @ np.linalg.inv(k)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    expected = cv2.warpPerspective(image, way, (280, 210), flags=flags, borderValue=(128,) * 3)
    assert np.array_equal(copied_picture(image, camera, copy), expected)


def _marking_pixel(
    camera: CameraParameters, distance: float, angle: float, along: float
) -> NDArray[np.float64]:
    """Place of a straight marking `distance` m to the right at `along` m ahead of the camera."""
    along += camera.x * np.cos(angle) + camera.y * np.sin(angle)
    ahead = along * np.cos(angle) + distance * np.sin(angle)
    left = along * np.sin(angle) - distance * np.cos(angle)
    found: NDArray[np.float64] = camera.project([[ahead, left, -camera.cg_height_m]])[0]
    return found
