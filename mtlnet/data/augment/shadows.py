"""Augments images by shadows of trees on the road; each shadow is computed once and reused.

A network trained on few shaded road sections mistakes the edges of shadows for markings.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from trackfeatures.camera import CameraParameters

SHADOWS = 64  # number of shadows; number 0 is no shadow
DARKNESS = (0.3, 0.75)  # share of the light that a shadow removes
COVERED = (0.15, 0.7)  # share of the road that is shaded
CELL_M = 0.08  # size of a cell of the noise field from which shadows are cut
LEAF_CELLS, CROWN_CELLS = 3.0, 14.0  # standard deviations, in cells, of the blur of leaves, crowns
MAX_DISTANCE_M = 40.0  # beyond this distance from the camera a shadow is uniform
FIELD = 1024  # cells per side


def add_shadow(image: NDArray[np.uint8], camera: CameraParameters, number: int) -> None:
    """Darken an image (H, W, 3) by shadow `number`, in place."""
    cv2.multiply(image, shadow_mask(camera, number), dst=image, scale=1 / 255)


def shadow_masks(camera: CameraParameters) -> NDArray[np.uint8]:
    """Return the remaining light, 0 to 255, in all 64 shadows (64, H, W, 3). It is 255 outside a
    shadow, and everywhere in shadow 0."""
    return np.stack([shadow_mask(camera, number) for number in range(SHADOWS)])


@lru_cache(maxsize=2 * SHADOWS)
def shadow_mask(camera: CameraParameters, number: int) -> NDArray[np.uint8]:
    """Return the remaining light (H, W, 3), 0 to 255, in shadow `number`. It is computed at the
    first use; all 64 shadows together take 6 s."""
    if number == 0:
        return np.full((camera.height, camera.width, 3), 255, np.uint8)
    rng = np.random.default_rng()
    rng.bit_generator.state = _state_before(number)
    drawn = _draw(rng)
    field = _field(drawn)
    ahead, left = road_points(camera)
    cosine, sine = np.cos(drawn.rotation), np.sin(drawn.rotation)
    u = (ahead * cosine - left * sine) / CELL_M + drawn.u
    v = (ahead * sine + left * cosine) / CELL_M + drawn.v
    shadow = field[u.astype(int) % FIELD, v.astype(int) % FIELD]
    far = ahead > MAX_DISTANCE_M
    shadow[far] = field.mean()
    shadow = cv2.GaussianBlur(shadow, (3, 3), 0.8)
    light = (255 * (1.0 - drawn.darkness * shadow) + 0.5).astype(np.uint8)
    return np.repeat(light[..., None], 3, axis=2)


@lru_cache(maxsize=2)
def road_points(camera: CameraParameters) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the point of a flat road that each pixel shows, as two arrays (H, W): m ahead and m
    left of the camera.

    Pixels above the horizon, or of points more than 80 m ahead, are set to 80 m ahead and 0 m left.
    """
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    ahead, left = (camera.road_points(pixels) - (camera.x, camera.y)).T
    near = ahead < 2 * MAX_DISTANCE_M  # false for NaN
    ahead, left = np.where(near, ahead, 2 * MAX_DISTANCE_M), np.where(near, left, 0.0)
    shape = rows.shape
    return ahead.reshape(shape), left.reshape(shape)


@dataclass(frozen=True)
class Drawn:
    """Random parameters of one shadow."""

    noise: NDArray[np.float32]  # (FIELD, FIELD)
    leaves: float  # weight of the leaves; the crowns have a weight of 1
    covered: float  # within `COVERED`
    rotation: float  # rad, of the field on the road
    u: float  # cells, the camera's position in the field
    v: float
    darkness: float  # within `DARKNESS`


def _draw(rng: np.random.Generator) -> Drawn:
    noise = rng.standard_normal((FIELD, FIELD)).astype(np.float32)
    leaves, covered = rng.uniform(0.1, 0.9), rng.uniform(*COVERED)
    rotation, u, v = rng.uniform(0, 2 * np.pi), rng.uniform(0, FIELD), rng.uniform(0, FIELD)
    return Drawn(noise, leaves, covered, rotation, u, v, rng.uniform(*DARKNESS))


@lru_cache(maxsize=SHADOWS)
def _state_before(number: int) -> Any:
    """Return the state of the generator before shadow `number`; one generator is used for all
    shadows."""
    rng = np.random.default_rng(0)
    if number > 1:
        rng.bit_generator.state = _state_before(number - 1)
        _draw(rng)
    return rng.bit_generator.state


def _field(drawn: Drawn) -> NDArray[np.float32]:
    """Return the shadow density (1024, 1024), 0 to 1, which is periodic in both directions."""
    total = np.zeros_like(drawn.noise)
    wide = np.pad(drawn.noise, 64, mode="wrap")
    for deviation, weight in ((CROWN_CELLS, 1.0), (LEAF_CELLS, drawn.leaves)):
        smooth = cv2.GaussianBlur(wide, (0, 0), deviation)[64:-64, 64:-64]
        total += weight * smooth / smooth.std()
    edge = np.quantile(total, 1.0 - drawn.covered)
    soft: NDArray[np.float32] = ((total - edge) / 0.15 + 0.5).clip(0.0, 1.0)
    return soft
