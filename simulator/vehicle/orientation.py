"""Converts between the axes of a body in the world frame and a quaternion (x, y, z, w)."""

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled, inlined


def quaternion(
    forward: NDArray[np.float64], left: NDArray[np.float64], up: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the unit quaternion (x, y, z, w) of the frame with the orthonormal axes `forward`,
    `left` and `up`, each (3,).

    Of four equivalent formulas, the one with the largest divisor is used (Shepperd, 1978).
    """
    trace = forward[0] + left[1] + up[2]
    w = 1.0 + trace
    x = 1.0 + 2.0 * forward[0] - trace
    y = 1.0 + 2.0 * left[1] - trace
    z = 1.0 + 2.0 * up[2] - trace
    cross = (left[2] - up[1], up[0] - forward[2], forward[1] - left[0])
    mixed = (forward[1] + left[0], forward[2] + up[0], left[2] + up[1])
    rows = [
        (w, [cross[0], cross[1], cross[2], w]),
        (x, [x, mixed[0], mixed[1], cross[0]]),
        (y, [mixed[0], y, mixed[2], cross[1]]),
        (z, [mixed[1], mixed[2], z, cross[2]]),
    ]
    best = np.array(max(rows, key=lambda row: row[0])[1])
    return np.asarray(best / np.linalg.norm(best))


@compiled
def rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the body axes (forward, left, up) of a unit quaternion (x, y, z, w), as the rows of a
    (3, 3) matrix."""
    axes = np.empty((3, 3))
    fill_axes(quaternion, axes)
    return axes


@inlined
def fill_axes(quaternion: NDArray[np.float64], axes: NDArray[np.float64]) -> None:
    """Fill `axes` (3, 3) with the body axes (forward, left, up) of a unit quaternion, as rows."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    axes[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    axes[0, 1] = 2.0 * (x * y + w * z)
    axes[0, 2] = 2.0 * (x * z - w * y)
    axes[1, 0] = 2.0 * (x * y - w * z)
    axes[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    axes[1, 2] = 2.0 * (y * z + w * x)
    axes[2, 0] = 2.0 * (x * z + w * y)
    axes[2, 1] = 2.0 * (y * z - w * x)
    axes[2, 2] = 1.0 - 2.0 * (x * x + y * y)
