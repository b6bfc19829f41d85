"""Renders the picture of a lens with distortion. A pinhole view that covers the lens's field of
view is drawn first; each pixel of the picture is then looked up in this view. Pixel coordinates are
whole numbers at the centres of pixels."""

from dataclasses import dataclass, replace
from math import ceil, cos, radians
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.core.render_modes import CLASSES
from trackfeatures.camera import CameraParameters

MAX_ANGLE_DEG = 72.0
"""Largest angle (deg) from the optical axis that one pinhole view covers. Pixels of the lens beyond
this angle are black."""
SHARPNESS = 1.5
"""Drawn pixels per pixel of the lens's picture, in each direction, where the lens magnifies
most."""
# Each pixel is the mean of SAMPLES x SAMPLES points, because a lens shrinks parts of the view.
SAMPLES = 2
MARGIN_PX = 2.0
_OUTSIDE = -1e4  # px: coordinate of points outside every view

Picture = NDArray[Any]


@dataclass(frozen=True)
class LensView:
    """The pinhole view `drawn` that stands in for a camera (H x W px) with distortion.
    `label_places` (2, H, W) are the positions (u, v), px, in the pinhole view of the camera's
    pixels. `colour_places` (2, 2 H, 2 W) are the positions of 2 x 2 points in each pixel, whose
    colours are averaged."""

    drawn: CameraParameters
    colour_places: NDArray[np.float32]
    label_places: NDArray[np.float32]

    @classmethod
    def of(cls, camera: CameraParameters, max_size: int) -> Self:
        """Build the pinhole view for `camera`; its sides have at most `max_size` px."""
        rays, fine = (_seen(camera.rays(_grid(camera, samples))) for samples in (1, SAMPLES))
        drawn = _cover(camera, fine, max_size)
        k = drawn.intrinsics()
        shapes = (camera.height * SAMPLES, camera.width * SAMPLES), (camera.height, camera.width)
        places = [
            np.nan_to_num((each @ k.T)[:, :2].T.reshape(2, *shape), nan=_OUTSIDE).astype(np.float32)
            for each, shape in zip((fine, rays), shapes, strict=True)
        ]
        return cls(drawn, *places)

    def colours(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the picture (H, W, 3) of the lens from `picture`, the drawn pinhole view
        (rows, columns, 3)."""
        u, v = self.colour_places
        found = cv2.remap(picture, u, v, cv2.INTER_LINEAR)
        height, width = self.label_places.shape[1:]
        return np.asarray(
            cv2.resize(found, (width, height), interpolation=cv2.INTER_AREA), np.uint8
        )

    def labels(self, labels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return depth and class (H, W, 2) seen through the lens from `labels`, the depth and class
        (rows, columns, 2) of the pinhole view. Pixels outside the lens's field of view have
        infinite depth and the class "sky"."""
        u, v = self.label_places
        found = cv2.remap(
            labels,
            u,
            v,
            cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(float("inf"), float(CLASSES.index("sky"))),
        )
        return np.asarray(found, np.float32)


def _grid(camera: CameraParameters, samples: int) -> FloatArray:
    """Return pixel coordinates (N, 2) of `samples` x `samples` points in each pixel, row by row."""
    columns, rows = (
        (np.arange(size * samples) + 0.5) / samples - 0.5 for size in (camera.width, camera.height)
    )
    return np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)


def _seen(rays: FloatArray) -> FloatArray:
    """Return `rays` (N, 3) with z = 1; rays beyond `MAX_ANGLE_DEG` from the axis become NaN."""
    limit = 1.0 / cos(radians(MAX_ANGLE_DEG))
    return np.where(np.linalg.norm(rays, axis=1, keepdims=True) <= limit, rays, np.nan)


def _cover(camera: CameraParameters, rays: FloatArray, max_size: int) -> CameraParameters:
    """Return a camera without distortion that covers `rays`, the rays of `_grid(camera, SAMPLES)`,
    at the resolution of the lens or finer, with sides of at most `max_size` px."""
    low, high = np.nanmin(rays[:, :2], axis=0), np.nanmax(rays[:, :2], axis=0)
    flat = rays[:, :2].reshape(camera.height * SAMPLES, camera.width * SAMPLES, 2)
    steps = [np.linalg.norm(np.diff(flat, axis=axis), axis=-1) for axis in (0, 1)]
    focal = SHARPNESS / (SAMPLES * min(np.nanmin(step) for step in steps))
    focal = min(focal, float((max_size - 2 * MARGIN_PX - 1) / (high - low).max()))
    width, height = (ceil(size * focal + 2 * MARGIN_PX) for size in (high - low))
    centre = MARGIN_PX - low * focal
    return replace(
        camera.undistorted(),
        width=width,
        height=height,
        matrix=(focal, focal, float(centre[0]), float(centre[1])),
    )
