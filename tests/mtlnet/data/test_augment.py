"""Changed images carry the labels of the changed scene; the changes are torchvision's."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torchvision.transforms.v2 import functional as vision

import trackfeatures as tf
from mtlnet.data.augment.geometric import metres_aside, shift_lateral
from mtlnet.data.augment.pipeline import (
    BRIGHTNESS,
    CAST,
    JPEG_SHARE,
    LUMA,
    PATCH_SHARE,
    PATCH_SIDE,
    TURN_LIMIT_RAD,
    TURN_RAD,
    TURN_SHARE,
    TURNS,
    AugmentParams,
    add_noise,
    blur,
    change_images,
    changed_labels,
    compress,
    draw_changes,
    homography,
    turn,
    turned_labels,
    turns,
)
from mtlnet.data.augment.shadows import SHADES, road_places, shade
from trackfeatures.camera import CameraParameters

SMALL = CameraParameters(width=70, height=52)


def none(count: int) -> AugmentParams:
    """No change at all."""
    drawn = draw_changes(count, SMALL.height, SMALL.width, np.random.default_rng(0))
    zeros = {name: np.zeros_like(value) for name, value in vars(drawn).items()}
    same = np.tile(np.eye(3, 4, dtype=np.float32), (count, 1, 1))
    return AugmentParams(**{**zeros, "colour": same})


def picture(seed: int = 0) -> NDArray[np.uint8]:
    """Smooth, as pictures are, and with an edge."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:210, :280]
    waves = [np.sin(rows / a + b) * np.cos(columns / c) for a, b, c in rng.uniform(8, 30, (3, 3))]
    image = 110 + 70 * np.stack(waves, 2)
    image[150:160] += 60
    return image.clip(0, 255).astype(np.uint8)


def as_tensor(image: NDArray[np.uint8]) -> torch.Tensor:
    return torch.from_numpy(image.copy()).permute(2, 0, 1)


def pixel_of(
    camera: CameraParameters, to_middle: float, yaw: float, point: NDArray[np.float64]
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
    camera, to_middle, yaw = CameraParameters(), 0.4, 0.05
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


@pytest.mark.parametrize("metres", [-0.5, 0.3])
@pytest.mark.parametrize("pitch_deg", [0.0, 4.0])
def test_a_shifted_image_is_that_of_a_car_aside(metres: float, pitch_deg: float) -> None:
    camera = CameraParameters(pitch_deg=pitch_deg)
    image = np.zeros((210, 280, 3), np.uint8)
    focal, tilt = 105 / np.tan(np.radians(33.75)), np.radians(pitch_deg)

    def column(row: int, left: float) -> float:
        """Where a line `left` of the camera is in a row: a ray's meeting with the road."""
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


def test_labels_of_a_car_aside_are_those_measured_there() -> None:
    moved = 0
    for lanes in (1, 2, 3):
        places = np.arange(-2.0 * lanes - 1.5, 2.0 * lanes + 1.5, 0.07)

        def measured(at: float, lanes: int = lanes) -> list[float]:
            found = tf.measure(at, 0.0, 0.0, 0.0, lanes, 4.0).distances.values()
            return [np.nan if d is None else d for d in found]

        before = np.array([measured(at) for at in places], np.float32)
        for share in (-0.98, 0.5, 0.98):
            metres = metres_aside(np.full(len(places), share), before)
            moved += int((np.abs(metres) > 0.25).sum())
            after = np.array([measured(at) for at in places + metres])
            np.testing.assert_allclose(before + metres[:, None], after, atol=1e-5)
    assert moved > 400  # of about 600: most have room


def test_shadows_darken_the_road_alone() -> None:
    camera = CameraParameters()
    white = np.full((210, 280, 3), 255, np.uint8)
    covered = []
    for which in (1, 20, SHADES - 1):
        image = white.copy()
        shade(image, camera, which)
        assert len(np.unique(image[:100])) <= 3  # an even light above the horizon
        assert image.min() >= 255 * 0.25 - 1
        road = image[120:, :, 0]
        covered.append(float((road < 0.5 * road.min() + 127).mean()))
    assert all(0.01 < share < 0.99 for share in covered)
    ahead, aside = road_places(camera)
    x, y = float(ahead[150, 30]), float(aside[150, 30])
    seen = pixel_of(camera, 0.0, 0.0, np.array([x + camera.x, y]))
    np.testing.assert_allclose(seen, [30.0, 150.0], atol=1e-9)


def test_turns_are_normal_and_move_the_picture() -> None:
    camera, deck = CameraParameters(), turns()
    assert deck[0].tolist() == [0.0, 0.0]
    yaw = deck[1:, 0]
    assert np.abs(yaw).max() <= TURN_LIMIT_RAD
    assert yaw.mean() == pytest.approx(0.0, abs=1e-9)
    assert yaw.std() == pytest.approx(TURN_RAD, rel=0.1)
    focal = 105 / np.tan(np.radians(33.75))
    for which in (1, 20, 50, TURNS - 1):
        image = np.zeros((210, 280, 3), np.uint8)
        image[:, 138:142] = 255  # a pole straight ahead
        turn(image, camera, which)
        column = (image[105, :, 0] * np.arange(280.0)).sum() / image[105, :, 0].sum()
        assert column == pytest.approx(139.5 + focal * np.tan(deck[which, 0]), abs=0.3)


def test_mirrored_images_have_mirrored_labels() -> None:
    images = np.stack([picture()[:52, :70], picture(1)[:52, :70]])
    before = images.copy()
    changes = replace(none(2), mirrored=np.array([False, True]))
    change_images(images, changes, SMALL)
    np.testing.assert_array_equal(images[0], before[0])
    np.testing.assert_array_equal(images[1], before[1, :, ::-1])
    distances = np.tile(np.array([-0.9, 3.1, np.nan, -0.9, 3.1], np.float32), (2, 1))
    angle = np.array([0.1, 0.1], np.float32)
    coded, heading = changed_labels(distances, angle, np.array([0, 0]), changes, SMALL)
    np.testing.assert_array_equal(coded[0], tf.encode(distances[:1], angle[:1])[0])
    mirrored, turned = tf.decode(coded[1:])
    np.testing.assert_allclose(mirrored[0], [-3.1, 0.9, -3.1, 0.9, np.nan], atol=1e-6)
    assert abs(turned[0] + 0.1) < 1e-6
    assert heading.tolist() == [0, 2]


def test_labels_follow_a_turn_and_then_the_mirror() -> None:
    changes = replace(none(1), turn=np.array([9]), mirrored=np.array([True]))
    yaw = turns()[9, 0]
    lane = np.array([[-2.0, 2.0, np.nan, np.nan, np.nan]], np.float32)
    coded, _ = changed_labels(
        lane, np.zeros(1, np.float32), np.array([1]), changes, CameraParameters()
    )
    distances, angle = tf.decode(coded)
    assert angle[0] == pytest.approx(yaw, abs=1e-6)  # turned: -yaw; mirrored: yaw
    aside = CameraParameters().x * np.sin(yaw)
    np.testing.assert_allclose(distances[0, :2], [-2 + aside, 2 + aside], atol=1e-6)


def test_covered_patches_are_few_and_small() -> None:
    drawn = draw_changes(256, 100, 140, np.random.default_rng(0))
    images = np.zeros((256, 100, 140, 3), np.uint8)
    change_images(images, replace(none(256), patch=drawn.patch), SMALL)
    share = (images.max(3) > 0).mean((1, 2))
    assert share.max() <= (PATCH_SIDE + 0.02) ** 2
    assert (share > 0).mean() == pytest.approx(PATCH_SHARE, abs=0.06)
    assert share[share > 0].mean() > 0.01


def colour(
    contrast: float = 1.0, brightness: float = 0.0, saturation: float = 1.0
) -> AugmentParams:
    """The change of one image that `draw_colours` makes of these."""
    mixed = saturation * np.eye(3) + (1 - saturation) * np.array(LUMA)
    shift = np.full((3, 1), 127.5 * (brightness + 1 - contrast))
    table = np.concatenate([contrast * mixed, shift], 1)[None].astype(np.float32)
    return replace(none(1), colour=table)


def test_colours_are_torchvisions() -> None:
    before = picture()
    saturated, scaled = before[None].copy(), before[None].copy()
    change_images(saturated, colour(saturation=0.5), CameraParameters())
    # torchvision rounds its luma (0.2989, 0.587, 0.114) to a whole level first.
    expected = vision.adjust_saturation(as_tensor(before), 0.5)
    assert int((as_tensor(saturated[0]).int() - expected.int()).abs().max()) <= 1
    change_images(scaled, colour(contrast=1.3, brightness=0.3), CameraParameters())
    brighter = vision.adjust_brightness(as_tensor(before), 1.3)
    assert int((as_tensor(scaled[0]).int() - brighter.int()).abs().max()) <= 1


def test_drawn_colours_leave_the_middle_grey_on_average() -> None:
    table = draw_changes(2000, 52, 70, np.random.default_rng(0)).colour
    grey = table @ np.array([127.5, 127.5, 127.5, 1.0], np.float32)
    assert grey.mean() == pytest.approx(127.5, abs=2.0)
    assert grey.std() == pytest.approx(127.5 * np.hypot(BRIGHTNESS, CAST) / np.sqrt(3), rel=0.1)


def test_blur_noise_and_compression_are_torchvisions() -> None:
    before = picture()
    blurred, noisy, packed = before.copy(), before.copy(), before.copy()
    blur(blurred, 1.2)
    expected = vision.gaussian_blur(as_tensor(before), [5, 5], [1.2, 1.2])
    inside = (as_tensor(blurred).int() - expected.int())[:, 3:-3, 3:-3]
    assert int(inside.abs().max()) <= 1
    add_noise(noisy, 6.0, 1234)
    added = noisy.astype(np.float64) - before
    free = (before > 40) & (before < 215)
    assert added[free].mean() == pytest.approx(0.0, abs=0.1)
    assert added[free].std() == pytest.approx(6.0, rel=0.03)
    compress(packed, 40)
    theirs = vision.jpeg(as_tensor(before), 40)
    difference = (as_tensor(packed).float() - theirs.float()).abs()
    lost = (theirs.float() - as_tensor(before).float()).abs()
    assert float(difference.mean()) < 0.2 * float(lost.mean())
    assert float(lost.mean()) > 0.5


def test_shares_of_what_is_drawn() -> None:
    drawn = draw_changes(4000, 210, 280, np.random.default_rng(1))
    assert (drawn.turn > 0).mean() == pytest.approx(TURN_SHARE, abs=0.03)
    assert (drawn.quality > 0).mean() == pytest.approx(JPEG_SHARE, abs=0.015)
    assert set(np.unique(drawn.turn)) == set(range(TURNS))


def test_a_part_is_changed_as_the_whole() -> None:
    images = np.stack([picture(seed)[:52, :70] for seed in range(6)])
    part = images[2:4].copy()
    changes = draw_changes(6, 52, 70, np.random.default_rng(3))
    change_images(images, changes, SMALL)
    change_images(part, changes.take(slice(2, 4)), SMALL)
    np.testing.assert_array_equal(part, images[2:4])
