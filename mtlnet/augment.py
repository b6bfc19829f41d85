"""Frames changed for training, with labels that change as the scene would.

All draw from the generator they are given, and change uint8 images (B, H, W, 3) in place.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.card import Camera

PATCHES = 3  # at most so many are covered, each at most this share of the image's sides
PATCH_SIDE = 0.3
TURN_SHARE = 0.5  # of the images
TURN_RAD, NOD_RAD = 0.035, 0.006  # standard deviations
TURN_LIMIT_RAD = 0.09
BRIGHTNESS, CONTRAST, TINT, CAST = 0.25, 0.3, 0.12, 0.08


def turn(
    images: NDArray[np.uint8], camera: Camera, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Turn the camera of some images left by a random yaw, with a little pitch; the yaws (B,) rad.

    Exact up to the border: a turn about the optical centre is a homography, whatever the scene.
    """
    count, height, width = images.shape[:3]
    drawn = rng.normal(0.0, TURN_RAD, (count,)).clip(-TURN_LIMIT_RAD, TURN_LIMIT_RAD)
    yaw: NDArray[np.float64] = np.where(rng.random(count) < TURN_SHARE, drawn, 0.0)
    pitch = rng.normal(0.0, NOD_RAD, (count,))
    for row in np.flatnonzero(yaw):
        warp = homography(camera, float(yaw[row]), float(pitch[row]))
        cv2.warpPerspective(
            images[row].copy(),
            warp,
            (width, height),
            dst=images[row],
            borderMode=cv2.BORDER_REFLECT_101,
        )
    return yaw


def homography(camera: Camera, yaw: float, pitch: float = 0.0) -> NDArray[np.float64]:
    """Where pixels go, (3, 3), when the car turns left by `yaw` and the camera down by `pitch`."""
    focal = camera.height / 2 / np.tan(np.radians(camera.fov_y_deg) / 2)
    intrinsics = np.array(
        [[focal, 0, (camera.width - 1) / 2], [0, focal, (camera.height - 1) / 2], [0, 0, 1]]
    )
    cosine, sine = np.cos(yaw), np.sin(yaw)
    # Camera frame: x right, y down, z ahead. What was ahead lies to the right of a left turn.
    about_vertical = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    tilt = np.radians(camera.pitch_deg)
    rotation = _about_right(tilt + pitch) @ about_vertical @ _about_right(-tilt)
    moved: NDArray[np.float64] = intrinsics @ rotation @ np.linalg.inv(intrinsics)
    return moved


def _about_right(down: float) -> NDArray[np.float64]:
    cosine, sine = np.cos(down), np.sin(down)
    return np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])


def turned_labels(
    distances: NDArray[np.float32],
    angle: NDArray[np.float32],
    yaw: NDArray[np.float64],
    camera: Camera,
) -> NDArray[np.float32]:
    """Coded targets (B, 6) after the turns `yaw` (B,): of a car whose camera stays where it is.

    Its centre of gravity, `camera.x` behind, swings to the right by camera.x sin(yaw).
    """
    aside = -camera.x * np.sin(yaw)
    return tf.encode(distances + aside[:, None], angle - yaw)


def mirror(
    images: NDArray[np.uint8],
    coded: NDArray[np.float32],
    heading: NDArray[np.int64],
    chosen: NDArray[np.bool_],
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Mirror the `chosen` (B,) images; the targets of the batch, theirs mirrored."""
    for row in np.flatnonzero(chosen):
        images[row] = images[row, :, ::-1]
    mirrored = np.where(chosen[:, None], tf.mirror_coded(coded), coded).astype(np.float32)
    return mirrored, np.where(chosen, tf.mirror_heading(heading), heading)


def cover(images: NDArray[np.uint8], rng: np.random.Generator) -> None:
    """Cover up to `PATCHES` rectangles of each image with one colour each.

    So that no single tree, cloud or piece of a marking is what a round is known by.
    """
    height, width = images.shape[1:3]
    for image in images:
        for _ in range(rng.integers(PATCHES + 1)):
            top, left = rng.integers(height), rng.integers(width)
            rows = rng.integers(1, int(PATCH_SIDE * height) + 2)
            columns = rng.integers(1, int(PATCH_SIDE * width) + 2)
            image[top : top + rows, left : left + columns] = rng.integers(0, 256, 3)


def colours(
    count: int, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A gain and a shift (B, 1, 1, 3) of normalised colours: another light, another camera."""
    gain = np.exp(
        rng.uniform(-CONTRAST, CONTRAST, (count, 1, 1, 1))
        + rng.uniform(-TINT, TINT, (count, 1, 1, 3))
    )
    shift = rng.uniform(-BRIGHTNESS, BRIGHTNESS, (count, 1, 1, 1)) + rng.uniform(
        -CAST, CAST, (count, 1, 1, 3)
    )
    return gain.astype(np.float32), shift.astype(np.float32)
