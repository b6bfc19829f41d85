"""Overlays of markings: projections at known pixels, signs, absent distances."""

import numpy as np
import pytest

from mtlnet.inference.overlay import SCALE, draw_overlay, marking_line, to_pixels
from trackfeatures.camera import CameraParameters

CAMERA = CameraParameters(
    width=200, height=100, fov_y_deg=90.0, x=0.0, y=0.0, z=0.75, pitch_deg=0.0
)
NOTHING = dict.fromkeys(("ml", "mr", "l", "m", "r"))


def test_a_road_point_is_projected_by_the_pinhole_model() -> None:
    # 90 degrees over 100 px: focal length 50 px. 10 m ahead, 2 m left, 1 m below the camera.
    pixels = to_pixels(np.array([[10.0, 2.0]]), CAMERA)
    assert pixels.tolist() == [[(100 - 50 * 2 / 10) * SCALE, (50 + 50 * 1 / 10) * SCALE]]


def test_a_positive_distance_is_drawn_to_the_right() -> None:
    line = marking_line(2.0, angle=0.0, curvature=0.0)
    assert (line[:, 1] == -2.0).all()
    assert (to_pixels(line, CAMERA)[:, 0] > 100 * SCALE).all()


def test_a_marking_goes_left_when_the_car_points_right() -> None:
    line = marking_line(0.0, angle=0.1, curvature=0.0)
    assert line[-1] == pytest.approx([14 * np.cos(0.1), 14 * np.sin(0.1)])


def test_a_marking_in_a_left_bend_curves_left() -> None:
    assert marking_line(0.0, 0.0, curvature=0.01)[-1, 1] == pytest.approx(0.01 * 14**2 / 2)


def test_absent_distances_are_not_drawn() -> None:
    frame = np.zeros((100, 200, 3), np.uint8)
    empty = draw_overlay(frame, CAMERA, 0.0, (NOTHING, 0.0), (NOTHING, 0.0))
    drawn = draw_overlay(frame, CAMERA, 0.0, (NOTHING, 0.0), ({**NOTHING, "mr": 2.0}, 0.0))
    changed = (drawn != empty).any(axis=2)
    assert changed[:, : 200 * SCALE // 2].sum() == 0, "nothing on the left half of the frame"
    red, _, blue = drawn[changed].astype(int).T
    assert changed.any()
    assert (red >= blue).all(), "in the answer's orange, antialiased"
