"""Places beside the road: which of them are free, and how high the ground is there. World frame,
metres."""

import numpy as np
from numpy.typing import NDArray

from simulator.camera.scene.road_mesh import Ribbon
from simulator.camera.scene.terrain import CentreLine, Terrain
from simulator.track.road import Road

FloatArray = NDArray[np.float64]


def place_beside(
    road: Road, line: CentreLine, s: FloatArray, offset: FloatArray, clear_m: float | FloatArray
) -> tuple[NDArray[np.bool_], FloatArray, FloatArray]:
    """Which of the places (s, offset) are `clear_m` outside every wall line, and their x, y."""
    pose = road.track.at(s, offset)
    near = line.distance(pose.x, pose.y)
    # Samples of the centre line lie SAMPLE_M apart; half a step of slack covers the gaps.
    free = near > road.wall_offset + clear_m
    return free, pose.x, pose.y


def ground_height(
    ribbon: Ribbon,
    terrain: Terrain,
    s: FloatArray,
    offset: FloatArray,
    x: FloatArray,
    y: FloatArray,
) -> FloatArray:
    """Height of what is seen at a place: the land, or the ribbon's skirt where that is higher."""
    row = np.clip(np.searchsorted(ribbon.s, s), 0, len(ribbon.s) - 1)
    skirt = ribbon.ground(row, offset)
    on_skirt = (offset < ribbon.y[row, 0]) & (offset > ribbon.y[row, -1])
    land = terrain.height(x, y)
    return np.where(on_skirt, np.maximum(land, skirt), land)
