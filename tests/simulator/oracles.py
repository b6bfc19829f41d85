"""Brute-force range beams, the reference for `simulator.sensors.beams` in tests and benchmarks.

Both edges of the road are polylines, other cars are rectangles; a beam ends at the nearest segment
that it intersects. Metres, radians; about 1 ms per pose.
"""

import math

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.sensors.beams import RANGE_M
from simulator.track.road import Road

FloatArray = NDArray[np.float64]

NO_BOXES: FloatArray = np.zeros((0, 6))


class BruteForce:
    """All segments of a road's edges, `step_m` long along the centre line.

    A chord of 0.2 m deviates 0.3 mm from a bend of 20 m radius; beams nearly parallel to the edge
    multiply this error.
    """

    def __init__(self, road: Road, step_m: float = 0.2) -> None:
        s = np.linspace(0.0, road.track.length_m, math.ceil(road.track.length_m / step_m) + 1)
        edges = [road.track.at(s, side * road.edge) for side in (1.0, -1.0)]
        points = [np.column_stack((edge.x, edge.y)) for edge in edges]
        self._start = np.concatenate([line[:-1] for line in points])
        self._along = np.concatenate([np.diff(line, axis=0) for line in points])

    def distances(
        self,
        x: float,
        y: float,
        yaw: float,
        angles: FloatArray,
        boxes: FloatArray = NO_BOXES,
        size: tuple[float, float] = (0.0, 0.0),
    ) -> FloatArray:
        """Distances (n,) to the first segment along each of `angles` (n,) from the heading.

        `boxes` (k, 6) are poses with x, y first and yaw last, `size` their length and width.
        """
        corners, sides = _rectangles(boxes, size)
        distances = np.full(len(angles), RANGE_M)
        cut_by(self._start, self._along, x, y, yaw + angles, distances)
        cut_by(corners, sides, x, y, yaw + angles, distances)
        return distances


@compiled
def cut_by(
    starts: FloatArray,
    sides: FloatArray,
    x: float,
    y: float,
    directions: FloatArray,
    distances: FloatArray,
) -> None:
    """Shorten `distances` (n,) of rays from (x, y) to the nearest segment (m, 2) that each ray
    intersects."""
    for i in range(directions.shape[0]):
        ray_x, ray_y = math.cos(directions[i]), math.sin(directions[i])
        for k in range(starts.shape[0]):
            across = ray_x * sides[k, 1] - ray_y * sides[k, 0]
            if across == 0.0:
                continue
            dx, dy = starts[k, 0] - x, starts[k, 1] - y
            place = (dx * ray_y - dy * ray_x) / across
            distance = (dx * sides[k, 1] - dy * sides[k, 0]) / across
            if 0.0 <= place <= 1.0 and 0.0 < distance < distances[i]:
                distances[i] = distance


def _rectangles(boxes: FloatArray, size: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """Start point and side vector (4 k, 2) of the sides of the rectangles at `boxes` (k, 6)."""
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * 0.5 * np.array(size)
    cos_yaw, sin_yaw = np.cos(boxes[:, 5, None]), np.sin(boxes[:, 5, None])
    placed = np.stack(
        (
            boxes[:, 0, None] + cos_yaw * corners[:, 0] - sin_yaw * corners[:, 1],
            boxes[:, 1, None] + sin_yaw * corners[:, 0] + cos_yaw * corners[:, 1],
        ),
        axis=-1,
    )
    return placed.reshape(-1, 2), (np.roll(placed, -1, axis=1) - placed).reshape(-1, 2)
