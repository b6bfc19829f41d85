"""Shadows of trees laid over a frame: patches on the road, drawn once and used again.

A shadow is a property of the place where it was recorded; a network that saw few such places takes
its edges for markings.
"""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from trackfeatures.camera import CameraParameters

SHADES = 64  # shadows to choose from; the first is none
DARKNESS = (0.3, 0.75)  # of the light, what a shadow takes
COVERED = (0.15, 0.7)  # of the road
CELL_M = 0.08  # of the field that shadows are cut from
LEAVES_CELLS, CROWN_CELLS = 3.0, 14.0  # standard deviations: flecks of light, whole crowns
FURTHEST_M = 40.0  # beyond it a shadow is even
FIELD = 1024  # cells a side


def shade(image: NDArray[np.uint8], camera: CameraParameters, which: int) -> None:
    """Darken an image (H, W, 3) by shadow number `which`, in place."""
    cv2.multiply(image, shades(camera)[which], dst=image, scale=1 / 255)


@lru_cache(maxsize=2)
def shades(camera: CameraParameters) -> NDArray[np.uint8]:
    """What is left of the light (SHADES, H, W, 3), 255 where there is no shadow."""
    rng = np.random.default_rng(0)
    ahead, aside = road_places(camera)
    drawn = np.full((SHADES, camera.height, camera.width, 3), 255, np.uint8)
    for which in range(1, SHADES):
        field = _field(rng)
        turned = rng.uniform(0, 2 * np.pi)
        u = (ahead * np.cos(turned) - aside * np.sin(turned)) / CELL_M + rng.uniform(0, FIELD)
        v = (ahead * np.sin(turned) + aside * np.cos(turned)) / CELL_M + rng.uniform(0, FIELD)
        shadow = field[u.astype(int) % FIELD, v.astype(int) % FIELD]
        even = ahead > FURTHEST_M
        shadow[even] = field.mean()
        shadow = cv2.GaussianBlur(shadow, (3, 3), 0.8)
        left = 1.0 - rng.uniform(*DARKNESS) * shadow
        drawn[which] = (255 * left + 0.5).astype(np.uint8)[..., None]
    return drawn


def road_places(camera: CameraParameters) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Which place of a flat road each pixel shows, (H, W) each: m ahead, m to the left.

    Above the horizon and far away: at least `FURTHEST_M` ahead.
    """
    focal = camera.focal_px
    tilt = np.radians(camera.pitch_deg)
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    down = (rows - (camera.height - 1) / 2) * np.cos(tilt) + focal * np.sin(tilt)
    height = camera.height_above_road_m
    depth = focal * height / np.maximum(down, focal * height / (2 * FURTHEST_M))
    return depth, -(columns - (camera.width - 1) / 2) * depth / focal


def _field(rng: np.random.Generator) -> NDArray[np.float32]:
    """A field of shadow (FIELD, FIELD) in [0, 1] that repeats without a seam."""
    noise = rng.standard_normal((FIELD, FIELD)).astype(np.float32)
    total = np.zeros_like(noise)
    for deviation, weight in ((CROWN_CELLS, 1.0), (LEAVES_CELLS, rng.uniform(0.1, 0.9))):
        wide = np.pad(noise, 64, mode="wrap")
        smooth = cv2.GaussianBlur(wide, (0, 0), deviation)[64:-64, 64:-64]
        total += weight * smooth / smooth.std()
    edge = np.quantile(total, 1.0 - rng.uniform(*COVERED))
    soft: NDArray[np.float32] = ((total - edge) / 0.15 + 0.5).clip(0.0, 1.0)
    return soft
