"""Augmentation by shadows of trees on the road, drawn once and used again.

A network trained on few shaded places mistakes the edges of shadows for markings.
"""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from trackfeatures.camera import CameraParameters

SHADOWS = 64  # shadows to choose from; number 0 is none
DARKNESS = (0.3, 0.75)  # share of the light that a shadow removes
COVERED = (0.15, 0.7)  # share of the road that is shaded
CELL_M = 0.08  # of the noise field from which shadows are cut
LEAF_CELLS, CROWN_CELLS = 3.0, 14.0  # standard deviations of the blur: leaves, crowns
MAX_DISTANCE_M = 40.0  # beyond it a shadow is uniform
FIELD = 1024  # cells a side


def add_shadow(image: NDArray[np.uint8], camera: CameraParameters, number: int) -> None:
    """Darken an image (H, W, 3) by shadow `number`, in place."""
    cv2.multiply(image, shadow_masks(camera)[number], dst=image, scale=1 / 255)


@lru_cache(maxsize=2)
def shadow_masks(camera: CameraParameters) -> NDArray[np.uint8]:
    """Remaining light (SHADOWS, H, W, 3), 255 where there is no shadow."""
    rng = np.random.default_rng(0)
    ahead, left = road_points(camera)
    masks = np.full((SHADOWS, camera.height, camera.width, 3), 255, np.uint8)
    for number in range(1, SHADOWS):
        field = _field(rng)
        rotation = rng.uniform(0, 2 * np.pi)
        u = (ahead * np.cos(rotation) - left * np.sin(rotation)) / CELL_M + rng.uniform(0, FIELD)
        v = (ahead * np.sin(rotation) + left * np.cos(rotation)) / CELL_M + rng.uniform(0, FIELD)
        shadow = field[u.astype(int) % FIELD, v.astype(int) % FIELD]
        far = ahead > MAX_DISTANCE_M
        shadow[far] = field.mean()
        shadow = cv2.GaussianBlur(shadow, (3, 3), 0.8)
        light = 1.0 - rng.uniform(*DARKNESS) * shadow
        masks[number] = (255 * light + 0.5).astype(np.uint8)[..., None]
    return masks


def road_points(camera: CameraParameters) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Point of a flat road that each pixel shows, (H, W) each: m ahead, m left of the camera.

    Pixels above the horizon or far away are more than `MAX_DISTANCE_M` ahead.
    """
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    ahead, left = (camera.road_points(pixels) - (camera.x, camera.y)).T
    near = ahead < 2 * MAX_DISTANCE_M  # not NaN
    ahead, left = np.where(near, ahead, 2 * MAX_DISTANCE_M), np.where(near, left, 0.0)
    shape = rows.shape
    return ahead.reshape(shape), left.reshape(shape)


def _field(rng: np.random.Generator) -> NDArray[np.float32]:
    """Shadow density (FIELD, FIELD) in [0, 1], periodic in both directions."""
    noise = rng.standard_normal((FIELD, FIELD)).astype(np.float32)
    total = np.zeros_like(noise)
    for deviation, weight in ((CROWN_CELLS, 1.0), (LEAF_CELLS, rng.uniform(0.1, 0.9))):
        wide = np.pad(noise, 64, mode="wrap")
        smooth = cv2.GaussianBlur(wide, (0, 0), deviation)[64:-64, 64:-64]
        total += weight * smooth / smooth.std()
    edge = np.quantile(total, 1.0 - rng.uniform(*COVERED))
    soft: NDArray[np.float32] = ((total - edge) / 0.15 + 0.5).clip(0.0, 1.0)
    return soft
