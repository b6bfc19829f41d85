"""Augmentation: labels match the changed scene; photometric operations match torchvision."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torchvision.transforms.v2 import functional as vision

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
    shift_limits_m,
)
from mtlnet.data.augment.photometric import (
    BRIGHTNESS,
    CHANNEL_BRIGHTNESS,
    LUMA,
    add_noise,
    blur,
    compress,
)
from mtlnet.data.augment.pipeline import (
    BORDER_SHARE,
    JPEG_SHARE,
    MAX_BORDER,
    MAX_PATCH_SIDE,
    PATCH_SHARE,
    ROTATION_SHARE,
    AugmentParams,
    apply_params,
    augment_labels,
    draw_params,
)
from mtlnet.data.augment.shadows import SHADOWS, add_shadow, road_points, shadow_mask
from mtlnet.inference.rectification import BORDER_LEVEL
from trackfeatures.camera import CameraParameters

SMALL = CameraParameters(width=70, height=52)


def unchanged(count: int) -> AugmentParams:
    """Parameters that change nothing."""
    drawn = draw_params(count, SMALL.height, SMALL.width, np.random.default_rng(0))
    zeros = {name: np.zeros_like(value) for name, value in vars(drawn).items()}
    same = np.tile(np.eye(3, 4, dtype=np.float32), (count, 1, 1))
    return AugmentParams(**{**zeros, "colour": same})


def picture(seed: int = 0) -> NDArray[np.uint8]:
    """A smooth image (210, 280, 3) with an edge."""
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
    """Pinhole projection of a road point (x, y) in the track frame, m, to a pixel (u, v).

    The centre of gravity is at (0, to_middle), 0.25 m up; the camera `camera.x` ahead of it.
    """
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-ahead[1], ahead[0]])
    seen = point - (np.array([0.0, to_middle]) + camera.x * ahead)
    focal = camera.height / 2 / np.tan(np.radians(camera.fov_y_deg) / 2)
    centre = np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])
    below: NDArray[np.float64] = focal * np.array([-(seen @ left), camera.z + 0.25])
    return centre + below / float(seen @ ahead)


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
        positions = np.arange(-2.0 * lanes - 1.5, 2.0 * lanes + 1.5, 0.07)

        def measured(at: float, lanes: int = lanes) -> list[float]:
            found = tf.measure(at, 0.0, 0.0, 0.0, lanes, 4.0).distances.values()
            return [np.nan if d is None else d for d in found]

        before = np.array([measured(at) for at in positions], np.float32)
        for share in (-0.98, 0.5, 0.98):
            metres = lateral_shift_m(np.full(len(positions), share), before)
            moved += int((np.abs(metres) > 0.25).sum())
            after = np.array([measured(at) for at in positions + metres])
            np.testing.assert_allclose(before + metres[:, None], after, atol=1e-5)
    assert moved > 400  # of about 600: most can be shifted


def test_a_shadow_is_the_same_whichever_was_drawn_before_it() -> None:
    shadow_mask.cache_clear()
    third = shadow_mask(SMALL, 3)
    shadow_mask.cache_clear()
    in_order = [shadow_mask(SMALL, number) for number in range(4)]
    assert [bool((mask == third).all()) for mask in in_order] == [False, False, False, True]
    assert (in_order[0] == 255).all()


def test_shadows_darken_only_the_road() -> None:
    camera = CameraParameters()
    white = np.full((210, 280, 3), 255, np.uint8)
    covered = []
    for which in (1, 20, SHADOWS - 1):
        image = white.copy()
        add_shadow(image, camera, which)
        assert len(np.unique(image[:100])) <= 3  # uniform above the horizon
        assert image.min() >= 255 * 0.25 - 1
        road = image[120:, :, 0]
        covered.append(float((road < 0.5 * road.min() + 127).mean()))
    assert all(0.01 < share < 0.99 for share in covered)
    ahead, left = road_points(camera)
    x, y = float(ahead[150, 30]), float(left[150, 30])
    seen = pixel_of(camera, 0.0, 0.0, np.array([x + camera.x, y]))
    np.testing.assert_allclose(seen, [30.0, 150.0], atol=1e-9)


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


def test_mirrored_images_have_mirrored_labels() -> None:
    images = np.stack([picture()[:52, :70], picture(1)[:52, :70]])
    before = images.copy()
    params = replace(unchanged(2), mirrored=np.array([False, True]))
    apply_params(images, params, SMALL)
    np.testing.assert_array_equal(images[0], before[0])
    np.testing.assert_array_equal(images[1], before[1, :, ::-1])
    distances = np.tile(np.array([-0.9, 3.1, np.nan, -0.9, 3.1], np.float32), (2, 1))
    angle = np.array([0.1, 0.1], np.float32)
    coded, heading = augment_labels(distances, angle, np.array([0, 0]), params, SMALL)
    np.testing.assert_array_equal(coded[0], tf.encode(distances[:1], angle[:1])[0])
    mirrored, turned = tf.decode(coded[1:])
    np.testing.assert_allclose(mirrored[0], [-3.1, 0.9, -3.1, 0.9, np.nan], atol=1e-6)
    assert abs(turned[0] + 0.1) < 1e-6
    assert heading.tolist() == [0, 2]


def test_labels_are_rotated_then_mirrored() -> None:
    params = replace(unchanged(1), rotation=np.array([9]), mirrored=np.array([True]))
    yaw = rotations()[9, 0]
    lane = np.array([[-2.0, 2.0, np.nan, np.nan, np.nan]], np.float32)
    coded, _ = augment_labels(
        lane, np.zeros(1, np.float32), np.array([1]), params, CameraParameters()
    )
    distances, angle = tf.decode(coded)
    assert angle[0] == pytest.approx(yaw, abs=1e-6)  # rotated: -yaw; mirrored: yaw
    shift = CameraParameters().x * np.sin(yaw)
    np.testing.assert_allclose(distances[0, :2], [-2 + shift, 2 + shift], atol=1e-6)


def test_share_and_size_of_erased_patches() -> None:
    drawn = draw_params(256, 100, 140, np.random.default_rng(0))
    images = np.zeros((256, 100, 140, 3), np.uint8)
    apply_params(images, replace(unchanged(256), patch=drawn.patch), SMALL)
    share = (images.max(3) > 0).mean((1, 2))
    assert share.max() <= (MAX_PATCH_SIDE + 0.02) ** 2
    assert (share > 0).mean() == pytest.approx(PATCH_SHARE, abs=0.06)
    assert share[share > 0].mean() > 0.01


def test_half_of_the_images_show_what_a_narrower_camera_shows() -> None:
    """Most borders hide at most 40 % of the rows and half of the columns. A quarter of them (0.15
    of 0.575) hide as much as the model accepts: three quarters of the rows and columns, but never
    the whole road."""
    border = draw_params(20_000, 210, 280, np.random.default_rng(2)).border
    top, bottom, left, right = border.T
    assert border.any(1).mean() == pytest.approx(1 - (1 - BORDER_SHARE) * 0.85, abs=0.02)
    assert (210 - top - bottom).min() == pytest.approx(0.25 * 210, abs=2)
    assert (280 - left - right).min() == pytest.approx(0.25 * 280, abs=2)
    assert (210 - bottom).min() >= 0.54 * 210
    limits = (np.array(MAX_BORDER) * (210, 210, 280, 280)).round()
    assert 0.08 < (border > limits).any(1).mean() < 0.15
    usual = border[border.any(1) & (border <= limits).all(1)]
    np.testing.assert_allclose(usual.mean(0), limits / 2, rtol=0.08)
    images = np.stack([picture(), picture(1)])
    before = images.copy()
    cut = np.array([[0, 0, 0, 0], [10, 40, 20, 30]])
    apply_params(images, replace(unchanged(2), border=cut), CameraParameters())
    np.testing.assert_array_equal(images[0], before[0])
    np.testing.assert_array_equal(images[1, 10:170, 20:250], before[1, 10:170, 20:250])
    shown = np.zeros((210, 280), bool)
    shown[10:170, 20:250] = True
    assert (images[1][~shown] == BORDER_LEVEL).all()


def colour(
    contrast: float = 1.0, brightness: float = 0.0, saturation: float = 1.0
) -> AugmentParams:
    """Parameters of one image with this colour transform; see `draw_colour_transforms`."""
    mixed = saturation * np.eye(3) + (1 - saturation) * np.array(LUMA)
    shift = np.full((3, 1), 127.5 * (brightness + 1 - contrast))
    table = np.concatenate([contrast * mixed, shift], 1)[None].astype(np.float32)
    return replace(unchanged(1), colour=table)


def test_colour_transforms_match_torchvision() -> None:
    before = picture()
    saturated, scaled = before[None].copy(), before[None].copy()
    apply_params(saturated, colour(saturation=0.5), CameraParameters())
    # torchvision rounds its luma (0.2989, 0.587, 0.114) to a whole level first.
    expected = vision.adjust_saturation(as_tensor(before), 0.5)
    assert int((as_tensor(saturated[0]).int() - expected.int()).abs().max()) <= 1
    apply_params(scaled, colour(contrast=1.3, brightness=0.3), CameraParameters())
    brighter = vision.adjust_brightness(as_tensor(before), 1.3)
    assert int((as_tensor(scaled[0]).int() - brighter.int()).abs().max()) <= 1


def test_drawn_colour_transforms_keep_middle_grey_on_average() -> None:
    table = draw_params(2000, 52, 70, np.random.default_rng(0)).colour
    grey = table @ np.array([127.5, 127.5, 127.5, 1.0], np.float32)
    assert grey.mean() == pytest.approx(127.5, abs=2.0)
    assert grey.std() == pytest.approx(
        127.5 * np.hypot(BRIGHTNESS, CHANNEL_BRIGHTNESS) / np.sqrt(3), rel=0.1
    )


def test_blur_noise_and_compression_match_torchvision() -> None:
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
    expected_jpeg = vision.jpeg(as_tensor(before), 40)
    difference = (as_tensor(packed).float() - expected_jpeg.float()).abs()
    lost = (expected_jpeg.float() - as_tensor(before).float()).abs()
    assert float(difference.mean()) < 0.2 * float(lost.mean())
    assert float(lost.mean()) > 0.5


def test_shares_of_drawn_operations() -> None:
    drawn = draw_params(4000, 210, 280, np.random.default_rng(1))
    assert (drawn.rotation > 0).mean() == pytest.approx(ROTATION_SHARE, abs=0.03)
    assert (drawn.jpeg_quality > 0).mean() == pytest.approx(JPEG_SHARE, abs=0.015)
    assert set(np.unique(drawn.rotation)) == set(range(ROTATIONS))


def test_a_part_of_a_batch_is_changed_like_the_whole() -> None:
    images = np.stack([picture(seed)[:52, :70] for seed in range(6)])
    part = images[2:4].copy()
    params = draw_params(6, 52, 70, np.random.default_rng(3))
    apply_params(images, params, SMALL)
    apply_params(part, params.take(slice(2, 4)), SMALL)
    np.testing.assert_array_equal(part, images[2:4])


def test_unknown_markings_stay_unknown_and_stop_no_shift_within_the_lane() -> None:
    inf, nan = np.inf, np.nan
    distances = np.array(
        [
            [-1.7, 1.9, inf, inf, inf],  # in the lane: to half a metre from either marking
            [nan, nan, inf, inf, inf],  # nothing known: the lane could come into reach
            [nan, nan, inf, -0.3, 3.3],  # on the left marking of the lane
        ],
        np.float32,
    )
    limits = shift_limits_m(distances)
    np.testing.assert_allclose(limits[0], [-0.6, 0.6])  # the largest shift at all
    np.testing.assert_allclose(limits[1:], 0.0)
    near = shift_limits_m(np.array([[-0.8, 2.8, inf, inf, inf]], np.float32))
    np.testing.assert_allclose(near, [[-0.6, 0.3]], atol=1e-6)
    angle, heading = np.zeros(3, np.float32), np.array([-1, -1, 0])
    params = draw_params(3, 210, 280, np.random.default_rng(0))
    params = replace(
        params,
        shift=np.array([0.2, 0.0, 0.0]),
        rotation=np.zeros(3, np.int64),
        mirrored=np.array([False, True, True]),
    )
    coded, classes = augment_labels(distances, angle, heading, params, CameraParameters())
    assert np.isnan(coded).tolist() == [
        [False, False, True, True, True, False],
        [False, False, True, True, True, False],
        [False, False, False, False, True, False],
    ]
    assert classes.tolist() == [-1, -1, 2]
    np.testing.assert_allclose(tf.decode_values(coded)[0, :2], [-1.5, 2.1], atol=1e-5)
