"""Augments a batch: makes random parameters, applies them to the images, changes the labels.

One random generator gives the parameters of a whole batch before any image is changed. Therefore a
process that makes only a part of the batch changes its images like a process that makes the whole
batch. Images are uint8 (H, W, 3), changed in place.
"""

from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.data.augment.geometric import (
    ROTATIONS,
    lateral_shift_m,
    rotate,
    rotate_labels,
    rotations,
    shift_lateral,
)
from mtlnet.data.augment.photometric import add_noise, blur, compress, draw_colour_transforms
from mtlnet.data.augment.shadows import SHADOWS, add_shadow
from mtlnet.inference.rectification import BORDER_LEVEL, LEAST_SHOWN
from trackfeatures.camera import CameraParameters

# Shares of augmented images. They are small, because a network sees each frame only about five
# times in an hour of training; with twice these shares its errors on all test frames were larger.
SHIFT_SHARE, ROTATION_SHARE, SHADOW_SHARE, PATCH_SHARE = 0.3, 0.3, 0.15, 0.125
BLUR_SHARE, NOISE_SHARE, JPEG_SHARE = 0.08, 0.12, 0.0625
BORDER_SHARE = 0.5
MAX_BORDER = (0.3, 0.3, 0.25, 0.25)
"""Maximum shares of the rows (top, bottom) and columns (left, right) that a border covers with
grey. `BORDER_SHARE` of the images have borders."""
NARROW_SHARE = 0.15
"""Share of images with borders like those of the narrowest field of view that is not refused."""
LOWEST_EDGE = 0.55
"""Minimum share of an image's rows that lie above its lower border, for the images of
`NARROW_SHARE`, so that they show some road."""
MAX_PATCH_SIDE = 0.3  # relative to the image's sides
BLUR_STD_PX, NOISE_STD, JPEG_QUALITY = (0.4, 1.4), (2.0, 12.0), (25, 90)


@dataclass(frozen=True)
class AugmentParams:
    """Augmentation parameters of B images. Where a parameter is 0, its change is not made; `colour`
    is always applied."""

    shift: NDArray[np.float64]  # (B,) m to the left; a share before `resolve_lateral_shift`
    rotation: NDArray[np.int64]  # (B,) number of one of `ROTATIONS`
    mirrored: NDArray[np.bool_]  # (B,)
    shadow: NDArray[np.int64]  # (B,) number of one of `SHADOWS`
    patch: NDArray[np.int64]  # (B, 7): top, left, rows, columns, r, g, b
    colour: NDArray[np.float32]  # (B, 3, 4): affine colour transform
    blur_std: NDArray[np.float64]  # (B,) px
    noise_std: NDArray[np.float64]  # (B,) in levels of 0 to 255
    noise_start: NDArray[np.int64]  # (B,) index in the stored noise
    jpeg_quality: NDArray[np.int64]  # (B,)
    border: NDArray[np.int64]  # (B, 4) px without a picture at the top, bottom, left, right

    def take(self, rows: slice) -> "AugmentParams":
        """Return the parameters of the images in the slice `rows`."""
        return AugmentParams(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


def draw_params(count: int, height: int, width: int, rng: np.random.Generator) -> AugmentParams:
    """Return random parameters of `count` images of `height` x `width` px. Their `shift` is a share
    of the allowed shift; `resolve_lateral_shift` converts it to m before the parameters are
    applied."""
    return AugmentParams(
        shift=rng.uniform(-1.0, 1.0, count) * (rng.random(count) < SHIFT_SHARE),
        rotation=rng.integers(1, ROTATIONS, count) * (rng.random(count) < ROTATION_SHARE),
        mirrored=rng.random(count) < 0.5,
        shadow=rng.integers(1, SHADOWS, count) * (rng.random(count) < SHADOW_SHARE),
        patch=_draw_patch(count, height, width, rng),
        colour=draw_colour_transforms(count, rng),
        blur_std=rng.uniform(*BLUR_STD_PX, count) * (rng.random(count) < BLUR_SHARE),
        noise_std=rng.uniform(*NOISE_STD, count) * (rng.random(count) < NOISE_SHARE),
        noise_start=rng.integers(0, height * width * 3 + 1, count),
        jpeg_quality=rng.integers(*JPEG_QUALITY, count, endpoint=True)
        * (rng.random(count) < JPEG_SHARE),
        border=_draw_border(count, height, width, rng),
    )


def _draw_patch(count: int, height: int, width: int, rng: np.random.Generator) -> NDArray[np.int64]:
    rows = rng.integers(1, int(MAX_PATCH_SIDE * height) + 2, count)
    columns = rng.integers(1, int(MAX_PATCH_SIDE * width) + 2, count)
    rows[rng.random(count) >= PATCH_SHARE] = 0
    corner = rng.integers(0, (height, width), (count, 2))
    return np.column_stack([corner, rows, columns, rng.integers(0, 256, (count, 3))])


def _draw_border(
    count: int, height: int, width: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Return random borders (`count`, 4) of images of `height` x `width` px: px at the top, bottom,
    left and right, like the areas that a camera with a narrower field of view does not show."""
    share = rng.uniform(0.0, MAX_BORDER, (count, 4)) * (rng.random((count, 1)) < BORDER_SHARE)
    shown = rng.uniform(LEAST_SHOWN, 1.0, (count, 2))  # of rows and columns
    first = np.column_stack([np.maximum(LOWEST_EDGE - shown[:, 0], 0.0), np.zeros(count)])
    start = first + rng.random((count, 2)) * (1.0 - shown - first)
    narrow = np.stack([start, 1.0 - shown - start], 2).reshape(count, 4)
    share = np.where(rng.random((count, 1)) < NARROW_SHARE, narrow, share)
    return (share * (height, height, width, width)).round().astype(np.int64)


def resolve_lateral_shift(params: AugmentParams, distances: NDArray[np.float32]) -> AugmentParams:
    """Return `params` with `shift` converted from a share of the allowed shift to m, for frames
    with the labels `distances` (B, 5), m."""
    return replace(params, shift=lateral_shift_m(params.shift, distances))


def apply_params(
    images: NDArray[np.uint8], params: AugmentParams, camera: CameraParameters
) -> None:
    """Augment images (B, H, W, 3) in place. The changes are made in the order of image formation:
    of the scene, the light, the lens, and the file."""
    for row, image in enumerate(images):
        if params.shift[row]:
            shift_lateral(image, camera, float(params.shift[row]))
        if params.rotation[row]:
            rotate(image, camera, int(params.rotation[row]))
        if params.mirrored[row]:
            cv2.flip(image, 1, dst=image)
        if params.shadow[row]:
            add_shadow(image, camera, int(params.shadow[row]))
        top, left, rows, columns, *colour = params.patch[row].tolist()
        image[top : top + rows, left : left + columns] = colour
        cv2.transform(image, params.colour[row], dst=image)
        if params.blur_std[row]:
            blur(image, float(params.blur_std[row]))
        if params.noise_std[row]:
            add_noise(image, float(params.noise_std[row]), int(params.noise_start[row]))
        if params.jpeg_quality[row]:
            compress(image, int(params.jpeg_quality[row]))
        _clear_border(image, params.border[row].tolist())


def _clear_border(image: NDArray[np.uint8], border: list[int]) -> None:
    """Fill the border (top, bottom, left, right; px) of an image with grey, in place."""
    top, bottom, left, right = border
    image[:top] = BORDER_LEVEL
    image[image.shape[0] - bottom :] = BORDER_LEVEL
    image[:, :left] = BORDER_LEVEL
    image[:, image.shape[1] - right :] = BORDER_LEVEL


def augment_labels(
    distances: NDArray[np.float32],
    angle: NDArray[np.float32],
    heading: NDArray[np.int64],
    params: AugmentParams,
    camera: CameraParameters,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the coded targets (B, 6) and classes (B,) of the augmented images.

    `distances` (B, 5) in m, `angle` (B,) in rad and `heading` (B,) are the labels before the
    augmentation.
    """
    shift = (params.shift * np.cos(angle)).astype(np.float32)
    yaw = rotations()[params.rotation, 0]
    coded = rotate_labels(distances + shift[:, None], angle, yaw, camera)
    chosen = params.mirrored
    mirrored = np.where(chosen[:, None], tf.mirror_coded(coded), coded).astype(np.float32)
    return mirrored, np.where(chosen, tf.mirror_heading(heading), heading)
