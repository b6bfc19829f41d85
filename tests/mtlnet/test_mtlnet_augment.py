"""Changed images carry the labels of the changed scene."""

import numpy as np
import pytest
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.augment import (
    PATCH_SIDE,
    PATCHES,
    TURN_LIMIT_RAD,
    colours,
    cover,
    homography,
    mirror,
    turn,
    turned_labels,
)
from mtlnet.card import Camera


def pixel_of(
    camera: Camera, to_middle: float, yaw: float, point: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Pinhole projection from first principles: the pixel of a ground point (x, y) of the track.

    The centre of gravity is at (0, to_middle), 0.25 m up; the camera `camera.x` ahead of it.
    """
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-ahead[1], ahead[0]])
    seen = point - (np.array([0.0, to_middle]) + camera.x * ahead)
    focal = camera.height / 2 / np.tan(np.radians(camera.fov_y_deg) / 2)
    centre = np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])
    below: NDArray[np.float64] = focal * np.array([-(seen @ left), camera.z + 0.25])
    return centre + below / float(seen @ ahead)


@pytest.mark.parametrize("turned", [-0.08, 0.03])
def test_a_turned_image_is_that_of_the_turned_car(turned: float) -> None:
    camera, to_middle, yaw = Camera(), 0.4, 0.05
    # The camera stays: the centre of gravity swings about it.
    before, after = (np.array([np.cos(a), np.sin(a)]) for a in (yaw, yaw + turned))
    swung = np.array([0.0, to_middle]) + camera.x * (before - after)
    for point in np.array([[12.0, 2.0], [30.0, -2.0], [20.0, 0.0]]):
        source = pixel_of(camera, to_middle, yaw, point)
        goal = pixel_of(camera, swung[1], yaw + turned, point - [swung[0], 0.0])
        moved = homography(camera, turned) @ [*source, 1.0]
        np.testing.assert_allclose(moved[:2] / moved[2], goal, atol=1e-9)
    lane = np.array([-2.0, 2.0, np.nan, np.nan, np.nan])
    coded = turned_labels(
        np.array([lane + to_middle], np.float32),
        np.array([-yaw], np.float32),
        np.array([turned]),
        camera,
    )
    distances, angle = tf.decode(coded)
    assert angle[0] == pytest.approx(-yaw - turned, abs=1e-6)
    np.testing.assert_allclose(distances[0], lane + swung[1], atol=5e-3)


def test_turns_move_the_picture_and_stay_in_bounds() -> None:
    camera, rng = Camera(), np.random.default_rng(0)
    images = np.zeros((64, 210, 280, 3), np.uint8)
    images[:, :, 138:142] = 255  # a pole straight ahead
    yaw = turn(images, camera, rng)
    assert np.abs(yaw).max() <= TURN_LIMIT_RAD
    assert 0.3 < (yaw == 0).mean() < 0.7
    focal = 105 / np.tan(np.radians(33.75))
    columns = (images[:, 105, :, 0] * np.arange(280.0)).sum(1) / images[:, 105, :, 0].sum(1)
    np.testing.assert_allclose(columns, 139.5 + focal * np.tan(yaw), atol=0.3)


def test_mirrored_images_have_mirrored_labels() -> None:
    images = np.arange(2 * 2 * 3 * 3, dtype=np.uint8).reshape(2, 2, 3, 3)
    before = images.copy()
    near_left = tf.encode([[-0.9, 3.1, np.nan, -0.9, 3.1]], [0.1])
    coded = np.repeat(near_left, 2, 0)
    mirrored, heading = mirror(images, coded, np.array([0, 0]), np.array([False, True]))
    np.testing.assert_array_equal(images[0], before[0])
    np.testing.assert_array_equal(images[1], before[1, :, ::-1])
    np.testing.assert_array_equal(mirrored[0], coded[0])
    distances, angle = tf.decode(mirrored[1:])
    np.testing.assert_allclose(distances[0], [-3.1, 0.9, -3.1, 0.9, np.nan], atol=1e-6)
    assert abs(angle[0] + 0.1) < 1e-6
    assert heading.tolist() == [0, 2]


def test_covered_patches_are_few_and_small() -> None:
    images = np.zeros((64, 100, 140, 3), np.uint8)
    cover(images, np.random.default_rng(0))
    share = (images.max(3) > 0).mean((1, 2))
    assert share.max() <= PATCHES * (PATCH_SIDE + 0.02) ** 2
    assert 0.1 < (share == 0).mean() < 0.5
    assert share.mean() > 0.01


def test_colours_are_one_an_image_and_channel() -> None:
    gain, shift = colours(1000, np.random.default_rng(0))
    assert gain.shape == shift.shape == (1000, 1, 1, 3)
    assert abs(np.log(gain).mean()) < 0.02
    assert abs(shift.mean()) < 0.02
