"""Random poses of a car at rest, for rounds of the trajectory PLACED.

In a drive the angle to the road depends on the curvature: along a bend a slow car points out of the
bend. A network that is trained only on drives learns this relation, which is another one for
another vehicle. The angles of placed cars do not depend on the curvature.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.driving.trajectory import max_offset
from simulator.track.geometry import Track
from simulator.track.road import Road

FloatArray = NDArray[np.float64]

CELL_M = 1.0
RADII_M = (300.0, 100.0, 50.0, 25.0)
"""Limits of the five classes of radius. The radius of a place is that of the sharpest curvature
from the car to 20 m ahead (LOOK_AHEAD_M)."""
ANGLE_RAD = 0.1
"""Standard deviation of the angle to the road. It is twice that of the driver's trajectories."""
MAX_ANGLE_RAD = 0.3


@dataclass(frozen=True, slots=True)
class Placement:
    """Pose of a car on the road: position `s` on the lap (m), offset from the centre of the track
    (m, left positive), angle to the road (rad, positive if the car points to the right)."""

    s: float
    to_middle: float
    angle: float


def draw_placements(road: Road, count: int, rng: np.random.Generator) -> list[Placement]:
    """Return `count` random poses on `road`. The positions have the distribution of
    `placement_share`, the offsets a uniform one over the width that the driver's trajectories use,
    and the angles a normal one (standard deviation 0.1 rad, limited to 0.3 rad)."""
    share = placement_share(road.track)
    cells = rng.choice(len(share), size=count, p=share) + rng.uniform(size=count)
    s = cells * road.track.length_m / len(share)
    offset = rng.uniform(-1.0, 1.0, count) * max_offset(road)
    angle = np.clip(rng.normal(0.0, ANGLE_RAD, count), -MAX_ANGLE_RAD, MAX_ANGLE_RAD)
    return [Placement(*pose) for pose in np.stack([s, offset, angle], axis=1).tolist()]


def placement_share(track: Track) -> FloatArray:
    """Return the probability (N,) of each of the N cells of equal length of a lap, about 1 m long.

    Each class of radius (RADII_M) is chosen with a probability proportional to the square root of
    its share of the lap, so that rare radii are more frequent than on the road.
    """
    count = max(round(track.length_m / CELL_M), 1)
    curvature = np.abs(track.at((np.arange(count) + 0.5) * track.length_m / count).curvature)
    reach = 1 + min(round(tf.LOOK_AHEAD_M / CELL_M), count - 1)
    ahead = np.concatenate([curvature, curvature[: reach - 1]])
    sharpest = np.lib.stride_tricks.sliding_window_view(ahead, reach).max(axis=1)
    number = np.searchsorted(1.0 / np.array(RADII_M), sharpest)
    cells_of = np.bincount(number, minlength=len(RADII_M) + 1)
    weight = 1.0 / np.sqrt(cells_of[number])
    return np.asarray(weight / weight.sum())
