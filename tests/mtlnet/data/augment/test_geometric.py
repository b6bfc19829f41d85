"""Shifted and rotated images match a projection of the scene from the changed pose."""

import numpy as np
import pytest

import trackfeatures as tf
from mtlnet.data.augment.geometric import (
    MAX_YAW_RAD,
    ROTATIONS,
    YAW_STD_RAD,
    lateral_shift_m,
    rotate,
    rotate_labels,
    rotation_homography,
    rotations,
    shift_lateral,
)
from tests.mtlnet.data.augment.samples import pixel_of
from trackfeatures.camera import CameraParameters
from trackfeatures.definitions import OUTSIDE_REACH_M


@pytest.mark.parametrize("yaw_change", [-0.08, 0.03])
def test_rotation_matches_projection_and_labels_of_the_rotated_car(yaw_change: float) -> None:
    camera, to_middle, yaw = CameraParameters(), 0.4, 0.05
    # The camera stays in place; the centre of gravity moves around it.
    before, after = (np.array([np.cos(a), np.sin(a)]) for a in (yaw, yaw + yaw_change))
    moved_cg = np.array([0.0, to_middle]) + camera.x * (before - after)
    for point in np.array([[12.0, 2.0], [30.0, -2.0], [20.0, 0.0]]):
        source = pixel_of(camera, to_middle, yaw, point)
        goal = pixel_of(camera, moved_cg[1], yaw + yaw_change, point - [moved_cg[0], 0.0])
        moved = rotation_homography(camera, yaw_change) @ [*source, 1.0]
        np.testing.assert_allclose(moved[:2] / moved[2], goal, atol=1e-9)
    lane = np.array([-2.0, 2.0, np.nan, np.nan, np.nan])
    coded = rotate_labels(
        np.array([lane + to_middle], np.float32),
        np.array([-yaw], np.float32),
        np.array([yaw_change]),
        camera,
    )
    distances, angle = tf.decode(coded)
    assert angle[0] == pytest.approx(-yaw - yaw_change, abs=1e-6)
    np.testing.assert_allclose(distances[0], lane + moved_cg[1], atol=5e-3)


@pytest.mark.parametrize("metres", [-0.5, 0.3])
@pytest.mark.parametrize("pitch_deg", [0.0, 4.0])
def test_lateral_shift_matches_projection(metres: float, pitch_deg: float) -> None:
    camera = CameraParameters(pitch_deg=pitch_deg)
    image = np.zeros((210, 280, 3), np.uint8)
    focal, tilt = 105 / np.tan(np.radians(33.75)), np.radians(pitch_deg)

    def column(row: int, left: float) -> float:
        """Column of a line `left` m of the camera in a row: the ray meets the road there."""
        down = (row - 104.5) / focal * np.cos(tilt) + np.sin(tilt)
        return float(139.5 - focal * left * down / 1.2)

    rows = range(130, 180)
    for row in rows:
        weights = (2.0 - np.abs(np.arange(280) - column(row, 0.2))).clip(0.0) * 100
        image[row] = weights[:, None].astype(np.uint8)
    shift_lateral(image, camera, metres)
    for row in rows:
        seen = image[row, :, 0].astype(float)
        place = (seen * np.arange(280)).sum() / seen.sum()
        assert place == pytest.approx(column(row, 0.2 - metres), abs=0.3)


def test_shifted_labels_are_those_measured_at_the_shifted_position() -> None:
    moved = 0
    for lanes in (1, 2, 3):
        positions = np.arange(-2.0 * lanes - 3.03, 2.0 * lanes + 3.0, 0.07)

        def measured(at: float, lanes: int = lanes) -> list[float]:
            found = tf.measure(at, 0.0, 0.0, 0.0, lanes, 4.0).distances.values()
            return [np.nan if d is None else d for d in found]

        before = np.array([measured(at) for at in positions], np.float32)
        for share in (-0.98, 0.5, 0.98):
            metres = lateral_shift_m(np.full(len(positions), share), before)
            moved += int((np.abs(metres) > 0.25).sum())
            after = np.array([measured(at) for at in positions + metres])
            np.testing.assert_allclose(before + metres[:, None], after, atol=1e-5)
        # A car up to 2 m outside has a labelled marking; farther out it is not moved, because the
        # shift could make a marking visible that the label calls absent.
        is_far = np.abs(positions) > 2.0 * lanes + OUTSIDE_REACH_M
        np.testing.assert_array_equal(np.isnan(before).all(1), is_far)
        assert not lateral_shift_m(np.full(len(positions), 0.98), before)[is_far].any()
    assert moved > 400  # of about 600: most can be shifted


def test_rotations_are_normally_distributed_and_move_pixels() -> None:
    camera, angles = CameraParameters(), rotations()
    assert angles[0].tolist() == [0.0, 0.0]
    yaw = angles[1:, 0]
    assert np.abs(yaw).max() <= MAX_YAW_RAD
    assert yaw.mean() == pytest.approx(0.0, abs=1e-9)
    assert yaw.std() == pytest.approx(YAW_STD_RAD, rel=0.1)
    focal = 105 / np.tan(np.radians(33.75))
    for which in (1, 20, 50, ROTATIONS - 1):
        image = np.zeros((210, 280, 3), np.uint8)
        image[:, 138:142] = 255  # a pole straight ahead
        rotate(image, camera, which)
        column = (image[105, :, 0] * np.arange(280.0)).sum() / image[105, :, 0].sum()
        assert column == pytest.approx(139.5 + focal * np.tan(angles[which, 0]), abs=0.3)
