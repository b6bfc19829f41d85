"""Frames changed for training, with labels that change as the scene would.

What happens to a batch is drawn first, for all of it, from one generator: a process that makes
only some of its images changes them as one that makes all. Images are uint8 (H, W, 3), changed in
place by OpenCV. Colour, blur, noise, erasing and JPEG artefacts are torchvision v2's by meaning
(tests/mtlnet/data/test_augment.py holds them to it); its own take 3 to 30 times as long.
"""

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from statistics import NormalDist

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.data.augment.geometric import metres_aside, shift_lateral
from mtlnet.data.augment.shadows import SHADES, shade
from trackfeatures.camera import CameraParameters

# Of the images. Few: a run of an hour sees each frame some five times, and with twice as much of
# all this it learned less, on frames of its own as well as on others.
ASIDE_SHARE, TURN_SHARE, SHADE_SHARE, PATCH_SHARE = 0.3, 0.3, 0.15, 0.125
PATCH_SIDE = 0.3  # at most, of the image's sides
TURN_RAD, NOD_RAD = 0.035, 0.006  # standard deviations
TURN_LIMIT_RAD = 0.09
TURNS = 64  # turns to choose from: where pixels go is then worked out once
BRIGHTNESS, CONTRAST, TINT, CAST, SATURATION = 0.12, 0.15, 0.06, 0.04, 0.2
LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601
BLUR_SHARE, BLUR_PX = 0.08, (0.4, 1.4)
NOISE_SHARE, NOISE_LEVELS = 0.12, (2.0, 12.0)  # standard deviations, of 255
JPEG_SHARE, JPEG_QUALITY = 0.0625, (25, 90)
NOISE_UNIT = 32.0  # standard deviation of the stored noise, about 128


@dataclass(frozen=True)
class AugmentParams:
    """What is to happen to each of B images; 0 leaves it as it is."""

    aside: NDArray[np.float64]  # (B,) m to the left; as drawn: the share of the room there is
    turn: NDArray[np.int64]  # (B,) one of `TURNS`; 0 is none
    mirrored: NDArray[np.bool_]  # (B,)
    shade: NDArray[np.int64]  # (B,) one of `SHADES`; 0 is none
    patch: NDArray[np.int64]  # (B, 7): top, left, rows, columns, colour; no rows: none
    colour: NDArray[np.float32]  # (B, 3, 4): an affine function of the levels of a pixel
    blur: NDArray[np.float64]  # (B,) px, standard deviation
    noise: NDArray[np.float64]  # (B,) levels, standard deviation
    noise_at: NDArray[np.int64]  # (B,) where in the stored noise
    quality: NDArray[np.int64]  # (B,) of JPEG

    def take(self, rows: slice) -> "AugmentParams":
        """Those of some of the images."""
        return AugmentParams(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


def draw_changes(count: int, height: int, width: int, rng: np.random.Generator) -> AugmentParams:
    """The changes of a batch; `fit_to` the labels of its frames before they are made."""
    return AugmentParams(
        aside=rng.uniform(-1.0, 1.0, count) * (rng.random(count) < ASIDE_SHARE),
        turn=rng.integers(1, TURNS, count) * (rng.random(count) < TURN_SHARE),
        mirrored=rng.random(count) < 0.5,
        shade=rng.integers(1, SHADES, count) * (rng.random(count) < SHADE_SHARE),
        patch=_draw_patch(count, height, width, rng),
        colour=draw_colours(count, rng),
        blur=rng.uniform(*BLUR_PX, count) * (rng.random(count) < BLUR_SHARE),
        noise=rng.uniform(*NOISE_LEVELS, count) * (rng.random(count) < NOISE_SHARE),
        noise_at=rng.integers(0, height * width * 3 + 1, count),
        quality=rng.integers(*JPEG_QUALITY, count, endpoint=True)
        * (rng.random(count) < JPEG_SHARE),
    )


def _draw_patch(count: int, height: int, width: int, rng: np.random.Generator) -> NDArray[np.int64]:
    rows = rng.integers(1, int(PATCH_SIDE * height) + 2, count)
    columns = rng.integers(1, int(PATCH_SIDE * width) + 2, count)
    rows[rng.random(count) >= PATCH_SHARE] = 0
    corner = rng.integers(0, (height, width), (count, 2))
    return np.column_stack([corner, rows, columns, rng.integers(0, 256, (count, 3))])


def fit_to(changes: AugmentParams, distances: NDArray[np.float32]) -> AugmentParams:
    """The changes with how far to move aside in m, for frames of these distances (B, 5)."""
    return replace(changes, aside=metres_aside(changes.aside, distances))


def change_images(
    images: NDArray[np.uint8], changes: AugmentParams, camera: CameraParameters
) -> None:
    """Change images (B, H, W, 3) as a camera's picture comes about: scene, light, lens, file."""
    for row, image in enumerate(images):
        if changes.aside[row]:
            shift_lateral(image, camera, float(changes.aside[row]))
        if changes.turn[row]:
            turn(image, camera, int(changes.turn[row]))
        if changes.mirrored[row]:
            cv2.flip(image, 1, dst=image)
        if changes.shade[row]:
            shade(image, camera, int(changes.shade[row]))
        top, left, rows, columns, *colour = changes.patch[row].tolist()
        image[top : top + rows, left : left + columns] = colour
        cv2.transform(image, changes.colour[row], dst=image)
        if changes.blur[row]:
            blur(image, float(changes.blur[row]))
        if changes.noise[row]:
            add_noise(image, float(changes.noise[row]), int(changes.noise_at[row]))
        if changes.quality[row]:
            compress(image, int(changes.quality[row]))


@lru_cache(maxsize=1)
def turns() -> NDArray[np.float64]:
    """The turns (TURNS, 2) there are: yaw to the left, pitch down, rad; the first is none."""
    rng = np.random.default_rng(0)
    # Evenly dealt out of the normal distribution: a deck, not a draw.
    places = (np.arange(1, TURNS) - 0.5) / (TURNS - 1)
    yaw = [NormalDist(0.0, TURN_RAD).inv_cdf(place) for place in places]
    drawn = np.column_stack([yaw, rng.normal(0.0, NOD_RAD, TURNS - 1)])
    drawn[:, 0] = drawn[:, 0].clip(-TURN_LIMIT_RAD, TURN_LIMIT_RAD)
    return np.vstack([np.zeros(2), drawn])


def turn(image: NDArray[np.uint8], camera: CameraParameters, which: int) -> None:
    """Turn the camera by turn number `which`.

    Exact up to the border: a turn about the optical centre is a homography, whatever the scene.
    """
    coarse, fine = sources(camera, which)
    border = cv2.BORDER_REFLECT_101
    cv2.remap(image.copy(), coarse, fine, cv2.INTER_LINEAR, dst=image, borderMode=border)


@lru_cache(maxsize=TURNS)
def sources(camera: CameraParameters, which: int) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Where each pixel of a turned image comes from, as OpenCV's fixed-point maps."""
    back = np.linalg.inv(homography(camera, *turns()[which].tolist()))
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    x, y, scale = np.tensordot(back, np.stack([columns, rows, np.ones_like(rows)]), 1)
    maps = (x / scale).astype(np.float32), (y / scale).astype(np.float32)
    coarse, fine = cv2.convertMaps(*maps, cv2.CV_16SC2)
    return coarse.astype(np.int16, copy=False), fine.astype(np.uint16, copy=False)


def blur(image: NDArray[np.uint8], deviation_px: float) -> None:
    """Blur by a normal distribution: an unsharp lens."""
    side = 2 * round(2 * deviation_px) + 1
    cv2.GaussianBlur(image, (side, side), deviation_px, dst=image)


def add_noise(image: NDArray[np.uint8], deviation: float, at: int) -> None:
    """Add normal noise of a standard deviation in levels, a stretch of one stored field."""
    field = stored_noise(2 * image.size)[at : at + image.size].reshape(image.shape)
    share = deviation / NOISE_UNIT
    cv2.addWeighted(image, 1.0, field, share, -128.0 * share, dst=image)


@lru_cache(maxsize=2)
def stored_noise(size: int) -> NDArray[np.uint8]:
    """Normal noise (size,) about 128: drawing it anew would take longer than all the rest."""
    drawn = np.random.default_rng(0).standard_normal(size, np.float32)
    return (128 + NOISE_UNIT * drawn).round().clip(0, 255).astype(np.uint8)


def compress(image: NDArray[np.uint8], quality: int) -> None:
    """Write the image as a JPEG and read it again."""
    file = simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality, "RGB", "420")
    simplejpeg.decode_jpeg(file, "RGB", buffer=image)


def changed_labels(
    distances: NDArray[np.float32],
    angle: NDArray[np.float32],
    heading: NDArray[np.int64],
    changes: AugmentParams,
    camera: CameraParameters,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Coded targets (B, 6) and classes (B,) after the changes."""
    aside = (changes.aside * np.cos(angle)).astype(np.float32)
    coded = turned_labels(distances + aside[:, None], angle, turns()[changes.turn, 0], camera)
    chosen = changes.mirrored
    mirrored = np.where(chosen[:, None], tf.mirror_coded(coded), coded).astype(np.float32)
    return mirrored, np.where(chosen, tf.mirror_heading(heading), heading)


def homography(camera: CameraParameters, yaw: float, pitch: float = 0.0) -> NDArray[np.float64]:
    """Where pixels go, (3, 3), when the car turns left by `yaw` and the camera down by `pitch`."""
    focal = camera.focal_px
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
    camera: CameraParameters,
) -> NDArray[np.float32]:
    """Coded targets (B, 6) after the turns `yaw` (B,): of a car whose camera stays where it is.

    Its centre of gravity, `camera.x` behind, swings to the right by camera.x sin(yaw).
    """
    aside = -camera.x * np.sin(yaw)
    return tf.encode(distances + aside[:, None], angle - yaw)


def draw_colours(count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Another light, another camera: (B, 3, 4), from levels (r, g, b, 1) to levels.

    Saturation, then contrast about the middle and brightness, both also by colour.
    """
    kept = 1.0 + rng.uniform(-SATURATION, SATURATION, (count, 1, 1))
    mixed = kept * np.eye(3) + (1.0 - kept) * np.array(LUMA)
    gain = np.exp(
        rng.uniform(-CONTRAST, CONTRAST, (count, 1, 1)) + rng.uniform(-TINT, TINT, (count, 3, 1))
    )
    shift = rng.uniform(-BRIGHTNESS, BRIGHTNESS, (count, 1, 1)) + rng.uniform(
        -CAST, CAST, (count, 3, 1)
    )
    return np.concatenate([gain * mixed, 127.5 * (shift + 1.0 - gain)], 2).astype(np.float32)
