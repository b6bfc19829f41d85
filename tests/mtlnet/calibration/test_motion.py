"""Rotation and direction of travel from points of a known scene."""

import cv2
import numpy as np
import pytest

from mtlnet.calibration.motion import find_motion, follow


def test_motion_of_a_known_scene() -> None:
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-20, 20, 200), rng.uniform(-4, 1.2, 200)])
    points = np.column_stack([points, rng.uniform(8, 60, 200)])
    travel = 1.5 * np.array([0.05, -0.03, 1.0])
    turn = np.array([0.002, 0.006, -0.001])
    after = (points - travel) @ cv2.Rodrigues(turn)[0]  # rows: the inverse of the camera's turn
    tracks = np.column_stack([points[:, :2] / points[:, 2:], after[:, :2] / after[:, 2:]])
    tracks += rng.normal(0, 1e-4, tracks.shape)
    tracks[:20, 2:] += 0.05  # other cars
    motion = find_motion(tracks, np.array([0.07, -0.01]), 2e-4)
    assert motion is not None
    np.testing.assert_allclose(motion.towards, [0.05, -0.03], atol=0.004)
    np.testing.assert_allclose(motion.rotation, turn, atol=5e-4)
    assert motion.towards_std < 0.01


def test_points_in_one_place_show_no_motion() -> None:
    tracks = np.tile([0.1, 0.2, 0.11, 0.21], (50, 1))
    assert find_motion(tracks, np.array([0.0, 0.0]), 2e-4) is None


def test_points_are_followed() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (240, 320), np.uint8)
    before = cv2.GaussianBlur(noise, (0, 0), 2.0).astype(np.uint8)
    after = np.roll(before, (2, 5), axis=(0, 1))
    tracks = follow(before, after)
    assert tracks is not None
    assert np.median(tracks[:, 2] - tracks[:, 0]) == pytest.approx(5.0, abs=0.05)
    assert np.median(tracks[:, 3] - tracks[:, 1]) == pytest.approx(2.0, abs=0.05)
    assert tracks[:, 1].max() < 0.88 * 240  # not on the bonnet
    assert follow(before, before) is None  # nothing moves
    grey = np.full_like(before, 90)
    assert follow(grey, grey) is None
