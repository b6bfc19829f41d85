"""Pictures, parameters and a projection that several tests of the augmentation use."""

import numpy as np
from numpy.typing import NDArray

from mtlnet.data.augment.pipeline import (
    AugmentParams,
    draw_params,
)
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
