"""Where trees stand: seeded, beside the road, never on any part of it. World frame, metres."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.camera import foliage
from simulator.camera.look import Look
from simulator.camera.ribbon import Ribbon
from simulator.camera.terrain import CentreLine, Terrain
from simulator.track.road import Road

FloatArray = NDArray[np.float64]

CLEAR_M = 1.6
"""No trunk stands nearer to a wall line than this."""
HEIGHT_M = {
    "oak": (6.0, 12.0), "poplar": (9.0, 17.0), "pine": (8.0, 16.0), "fir": (7.0, 18.0),
    "palm": (6.0, 10.0), "bush": (1.2, 3.0), "birch": (7.0, 13.0),
}  # fmt: skip


@dataclass(frozen=True)
class Trees:
    """N trees: feet (N, 3), width and height (N,), cell of the atlas, colour tint (N, 3) and
    their place (s, offset) beside the road."""

    feet: FloatArray
    width: FloatArray
    height: FloatArray
    cell: NDArray[np.int64]
    tint: FloatArray
    s: FloatArray
    offset: FloatArray


def place_beside(
    road: Road, line: CentreLine, s: FloatArray, offset: FloatArray, clear_m: float
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


def plant(
    road: Road,
    line: CentreLine,
    ribbon: Ribbon,
    terrain: Terrain,
    look: Look,
    rng: np.random.Generator,
) -> Trees:
    """The trees of a scene; they stand in groves, denser near the road."""
    length = road.track.length_m
    density = look.tree_density * rng.uniform(0.6, 1.3)
    count = int(density * length / 100.0 * 2.0)
    s = rng.uniform(0.0, length, count)
    side = rng.choice([-1.0, 1.0], count)
    reach = look.tree_reach_m * rng.beta(1.1, 2.0, count)
    offset = side * (road.wall_offset + CLEAR_M + reach)
    # Groves and clearings: waves along s thin the trees out.
    phase = rng.uniform(0.0, 2 * np.pi, (3, 1))
    waves = np.sin(phase + 2 * np.pi * s / np.array([[310.0], [137.0], [71.0]]) + side)
    keep = rng.uniform(0.0, 1.0, count) < 0.55 + 0.3 * waves.sum(axis=0)
    kinds = rng.choice(np.array(look.trees), count)
    low, high = np.array([HEIGHT_M[kind] for kind in kinds]).reshape(-1, 2).T
    height = low + (high - low) * rng.beta(2.0, 2.0, count)
    width = height * np.array([foliage.ASPECT[kind] for kind in kinds])
    width *= rng.uniform(0.85, 1.15, count)
    free, x, y = place_beside(road, line, s, offset, CLEAR_M)
    # Branches may reach over the rail, not over the lanes.
    near = np.abs(offset) - width / 2.0
    keep &= free & (near > road.half_asphalt - 0.5)
    z = ground_height(ribbon, terrain, s, offset, x, y) - 0.12
    cell = np.array([foliage.KINDS.index(kind) for kind in kinds], dtype=np.int64)
    season = rng.choice([0.0, 0.0, 0.0, 0.35, 1.0])
    tint = _tints(rng, count, float(season))
    feet = np.stack([x, y, z], axis=1)
    return Trees(
        feet[keep], width[keep], height[keep], cell[keep], tint[keep], s[keep], offset[keep]
    )


def _tints(rng: np.random.Generator, count: int, autumn: float) -> FloatArray:
    """Colour factors (N, 3): each tree a little different, some of them turned in autumn."""
    tone = rng.uniform(0.7, 1.25, (count, 1))
    tint = tone * (1.0 + rng.uniform(-0.12, 0.12, (count, 3)))
    turned = rng.uniform(0.0, 1.0, count) < 0.6 * autumn
    tint[turned] *= np.array([2.0, 1.05, 0.5]) * rng.uniform(0.8, 1.1, (int(turned.sum()), 1))
    return tint
