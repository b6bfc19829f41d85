"""Augments images and their labels by another camera pose: a lateral shift and a rotation.

When the camera moves left by s m, a point at depth Z m appears s f / Z px further right, with f the
focal length in px. On a flat road this shift is s / h px per row below the horizon, with h the
height of the camera in m. So the image is sheared below the horizon and unchanged above it. This is
correct for markings near the car; objects that stand on the road are sheared too.

A rotation about the optical centre is a homography of the image (Hartley and Zisserman 2004,
section 8.4). It is exact for any scene, except at the image border.
"""

from dataclasses import replace
from functools import lru_cache
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from trackfeatures.camera import CameraParameters

MAX_SHIFT_M = 0.6
YAW_STD_RAD, PITCH_STD_RAD = 0.035, 0.006
MAX_YAW_RAD = 0.09
ROTATIONS = 64  # number of rotations, whose maps are computed once; number 0 is no rotation


def shift_lateral(image: NDArray[np.uint8], camera: CameraParameters, metres: float) -> None:
    """Change an image (H, W, 3), in place, as if its camera were `metres` further to the left."""
    horizon = horizon_row(camera)
    first = max(int(np.ceil(horizon)), 0)
    road = image[first:]
    shear = metres * shear_per_metre(camera)
    matrix = np.array([[1.0, shear, shear * (first - horizon)], [0.0, 1.0, 0.0]])
    # The new border gets the mean colour of the road; mirrored markings would be wrong there.
    fill = image[-1].mean(0).tolist()
    size = (camera.width, len(road))
    cv2.warpAffine(road.copy(), matrix, size, dst=road, flags=cv2.INTER_LINEAR, borderValue=fill)


def horizon_row(camera: CameraParameters) -> float:
    """Return the row of the horizon of a level road, px from the centre of the first row."""
    middle = camera.intrinsics()[1, 2]
    return float(middle - camera.focal_px * np.tan(np.radians(camera.pitch_deg)))


def shear_per_metre(camera: CameraParameters) -> float:
    """Return the shift to the right, px, of an image row that is one row below the horizon, when
    the camera moves to the left by one metre."""
    return float(np.cos(np.radians(camera.pitch_deg)) / camera.height_above_road_m)


def shift_limits_m(distances: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the limits (N, 2), m, of a shift of the camera to the right (negative) and to the
    left. Within the limits the labels after the shift can be computed from the labels before it.

    `distances` (N, 5) in m, NaN where absent, infinity where the label is unknown. Beyond a limit,
    a distance to a marking that is not labelled would be needed. A marking with an unknown label
    sets no limit for a car that has `ml` and `mr`; without these it allows no shift. A car without
    any marking, more than 2 m outside the road, is not shifted.
    """
    unknown = np.isinf(distances)
    ml, mr, l, m, r = np.where(unknown, np.nan, distances).astype(np.float64).T
    margin, reach = tf.IN_LANE_MARGIN_M, tf.ON_MARKING_REACH_M
    in_lane, on_marking = ~np.isnan(ml), ~np.isnan(m)
    low, high = np.full(len(m), -MAX_SHIFT_M), np.full(len(m), MAX_SHIFT_M)
    # A car in a lane stays at least `margin` from both markings, or `reach` if `m` is absent.
    least = np.where(on_marking | unknown[:, 3], margin, reach)
    low = np.where(in_lane, np.maximum(low, least - mr), low)
    high = np.where(in_lane, np.minimum(high, -least - ml), high)
    most = np.where(in_lane, reach, margin)
    low = np.where(on_marking, np.maximum(low, -most - m), low)
    high = np.where(on_marking, np.minimum(high, most - m), high)
    outside = on_marking & ((np.isnan(l) & (m > 0)) | (np.isnan(r) & (m < 0)))
    # A car far outside the road has no marking; where one would come into view is not labelled.
    nowhere = ~in_lane & (unknown.any(1) | ~on_marking)
    low[outside | nowhere] = high[outside | nowhere] = 0.0
    return np.column_stack([low.clip(max=0.0), high.clip(min=0.0)])


def lateral_shift_m(
    share: NDArray[np.float64], distances: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return the shifts (N,) to the left, m, for shares (N,) in [-1, 1] of the limits that
    `shift_limits_m` returns for `distances` (N, 5), m."""
    to_the_right, to_the_left = shift_limits_m(distances).T
    metres: NDArray[np.float64] = np.where(share < 0, -share * to_the_right, share * to_the_left)
    return metres


@lru_cache(maxsize=1)
def rotations() -> NDArray[np.float64]:
    """Return yaw to the left and pitch downwards, rad, of all 64 rotations (64, 2). Row 0 is
    zero."""
    rng = np.random.default_rng(0)
    # Quantiles, because so few random values would represent the normal distribution badly.
    quantiles = (np.arange(1, ROTATIONS) - 0.5) / (ROTATIONS - 1)
    yaw = [NormalDist(0.0, YAW_STD_RAD).inv_cdf(quantile) for quantile in quantiles]
    angles = np.column_stack([yaw, rng.normal(0.0, PITCH_STD_RAD, ROTATIONS - 1)])
    angles[:, 0] = angles[:, 0].clip(-MAX_YAW_RAD, MAX_YAW_RAD)
    return np.vstack([np.zeros(2), angles])


def rotate(image: NDArray[np.uint8], camera: CameraParameters, number: int) -> None:
    """Replace an image (H, W, 3), in place, by the image of a rotated camera. `number`: index, in
    the result of `rotations`, of the yaw and pitch."""
    coarse, fine = rotation_maps(camera, number)
    border = cv2.BORDER_REFLECT_101
    cv2.remap(image.copy(), coarse, fine, cv2.INTER_LINEAR, dst=image, borderMode=border)


@lru_cache(maxsize=ROTATIONS)
def rotation_maps(
    camera: CameraParameters, number: int
) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Return the source pixel of each pixel of an image rotated by rotation `number` (an index in
    `rotations`), as the fixed-point maps (H, W, 2) and (H, W) of cv2.remap."""
    inverse = np.linalg.inv(rotation_homography(camera, *rotations()[number].tolist()))
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    x, y, scale = np.tensordot(inverse, np.stack([columns, rows, np.ones_like(rows)]), 1)
    maps = (x / scale).astype(np.float32), (y / scale).astype(np.float32)
    coarse, fine = cv2.convertMaps(*maps, cv2.CV_16SC2)
    return coarse.astype(np.int16, copy=False), fine.astype(np.uint16, copy=False)


def rotation_homography(
    camera: CameraParameters, yaw: float, pitch: float = 0.0
) -> NDArray[np.float64]:
    """Return the homography (3, 3) from the pixels of an image to its pixels after the car is
    rotated left by `yaw` (rad) and the camera is tilted down by `pitch` (rad)."""
    return camera.homography(
        replace(
            camera,
            pitch_deg=camera.pitch_deg + float(np.degrees(pitch)),
            yaw_deg=camera.yaw_deg + float(np.degrees(yaw)),
        )
    )


def rotate_labels(
    distances: NDArray[np.float32],
    angle: NDArray[np.float32],
    yaw: NDArray[np.float64],
    camera: CameraParameters,
) -> NDArray[np.float32]:
    """Return the coded targets (B, 6) after the car is rotated left by `yaw` (B,) rad about its
    camera.

    `distances` (B, 5) in m and `angle` (B,) in rad are the labels before the rotation. The centre
    of gravity, `camera.x` behind the camera, moves to the right by camera.x sin(yaw).
    """
    shift = -camera.x * np.sin(yaw)
    return tf.encode(distances + shift[:, None], angle - yaw)
