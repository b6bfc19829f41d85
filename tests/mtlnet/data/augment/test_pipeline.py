"""Augmentation of a batch: shares of the operations, borders, and labels of the changed images."""

from dataclasses import replace

import numpy as np
import pytest

import trackfeatures as tf
from mtlnet.data.augment.geometric import (
    ROTATIONS,
    rotations,
    shift_limits_m,
)
from mtlnet.data.augment.pipeline import (
    BORDER_SHARE,
    JPEG_SHARE,
    MAX_BORDER,
    MAX_PATCH_SIDE,
    PATCH_SHARE,
    ROTATION_SHARE,
    apply_params,
    augment_labels,
    draw_params,
)
from mtlnet.inference.rectification import BORDER_LEVEL
from tests.mtlnet.data.augment.samples import SMALL, picture, unchanged
from trackfeatures.camera import CameraParameters


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
