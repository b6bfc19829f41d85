"""The same picture, taken by cameras that are mounted at other places of the car. Metres, rad.

A camera at another height sees a flat road enlarged by the ratio of the heights (Hartley and
Zisserman 2004, section 8.1): the picture does not show the height, so distances are measured in
heights of the camera.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trackfeatures.camera import CameraParameters


def scale_between(source: CameraParameters, target: CameraParameters) -> float:
    """Metres on the road beside `target` per metre beside `source`, of the same picture."""
    return target.height_above_road_m / source.height_above_road_m


def shift_between(
    angle: ArrayLike, source: CameraParameters, target: CameraParameters
) -> NDArray[np.float64]:
    """What the distances beside `target` differ by from the scaled ones beside `source`, in m.

    Distances are measured at the centre of gravity, which lies elsewhere beside each camera.
    """
    sine, cosine = np.sin(angle), np.cos(angle)
    scale = scale_between(source, target)
    shift: NDArray[np.float64] = (target.x - scale * source.x) * sine
    return shift - (target.y - scale * source.y) * cosine


def move_distances(
    distances: NDArray[np.floating],
    angle: ArrayLike,
    source: CameraParameters,
    target: CameraParameters,
) -> NDArray[np.float64]:
    """Distances (N, 5) beside a car with `target` that sees what one with `source` sees at
    `distances` and `angle` (N,)."""
    scaled = np.asarray(distances, dtype=np.float64) * scale_between(source, target)
    return scaled + shift_between(angle, source, target)[:, None]
