"""Selects positions, sizes and tints of the trees beside the road, by seed. World frame, metres."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.bridges.bridges import Bridge, free_of
from simulator.camera.scene.road_mesh import Ground
from simulator.camera.scene.themes import Theme
from simulator.camera.vegetation import foliage
from simulator.track.road import Road

CLEAR_M = 1.6
"""Least distance (m) of a trunk from a wall line."""
DRY_M = 1.5
"""Least height (m) of trees and props above the sea level."""
HEIGHT_M = {
    "oak": (6.0, 12.0), "poplar": (9.0, 17.0), "pine": (8.0, 16.0), "fir": (7.0, 18.0),
    "palm": (6.0, 10.0), "bush": (1.2, 3.0), "birch": (7.0, 13.0),
}  # fmt: skip

LEAF_SHEDDING = ("oak", "poplar", "birch", "bush")
"""Kinds of trees that may turn yellow or red in autumn."""
SHADY = ("oak", "birch", "pine", "fir")
AVENUE_STEP_M, OVERHANG_M = 18.0, 2.5
TUNNEL_STEP_M, TUNNEL_OVERHANG_M = 9.0, 4.5
"""Spacing of the trees of a tunnel, and distance that their crowns reach over the asphalt."""


@dataclass(frozen=True)
class Trees:
    """N trees. `feet` (N, 3), m, world, are their positions on the ground, `width` and `height`
    (N,) their sizes, m. `cell` (N,) is the index into `foliage.KINDS`, `tint` (N, 3) the factors on
    the colour. `s` and `offset` (N,), m, are the positions along and beside the road."""

    feet: FloatArray
    width: FloatArray
    height: FloatArray
    cell: NDArray[np.int64]
    tint: FloatArray
    s: FloatArray
    offset: FloatArray


def plant(
    ground: Ground,
    theme: Theme,
    bridges: Sequence[Bridge],
    rng: np.random.Generator,
    *,
    avenue: bool,
    tunnel: bool = False,
) -> Trees:
    """Select the trees of a scene. They stand in groves, denser near the road.

    `avenue` adds a row of tall trees behind the barriers on each side of the road; their crowns
    reach over the asphalt. `tunnel` adds denser rows, whose crowns close over the road.
    """
    road = ground.road
    sites = [_groves(road, theme, rng)]
    if avenue or tunnel:
        own = np.random.default_rng(rng.integers(2**32))
        sites.append(_avenue(road, theme, own, tunnel=tunnel))
    s, offset, kinds, size, overhang = (
        np.concatenate(column) for column in zip(*sites, strict=True)
    )
    low, high = np.array([HEIGHT_M[kind] for kind in kinds]).reshape(-1, 2).T
    height = low + (high - low) * size
    width = height * np.array([foliage.ASPECT[kind] for kind in kinds])
    width *= rng.uniform(0.85, 1.15, len(s))
    free, x, y = ground.place_beside(s, offset, CLEAR_M - 0.1)
    # Crowns may reach over the rail, and over the asphalt by 0.5 m and the kind's `overhang`.
    near = np.abs(offset) - width / 2.0
    keep = free & (near > road.half_asphalt - 0.5 - overhang) & free_of(bridges, x, y)
    z = ground.height(s, offset, x, y) - 0.12
    keep &= z > ground.terrain.sea + DRY_M
    cell = np.array([foliage.KINDS.index(kind) for kind in kinds], dtype=np.int64)
    season = rng.choice([0.0, 0.0, 0.0, 0.35, 1.0])
    tint = _tints(rng, np.isin(kinds, LEAF_SHEDDING), float(season))
    feet = np.stack([x, y, z], axis=1)
    return Trees(
        feet[keep], width[keep], height[keep], cell[keep], tint[keep], s[keep], offset[keep]
    )


Sites = tuple[FloatArray, FloatArray, NDArray[np.str_], FloatArray, FloatArray]
"""N candidate trees: s (m), offset (m), kind, size (0 to 1, from least to greatest height of the
kind), and the distance (m) that the crown may reach over the asphalt."""


def _groves(road: Road, theme: Theme, rng: np.random.Generator) -> Sites:
    """Return random trees in groves on both sides of the road, denser near it."""
    length = road.track.length_m
    density = theme.tree_density * rng.uniform(0.6, 1.3)
    count = int(density * length / 100.0 * 2.0)
    s = rng.uniform(0.0, length, count)
    side = rng.choice([-1.0, 1.0], count)
    reach = theme.tree_reach_m * rng.beta(1.1, 2.0, count)
    # Waves of density along s make groves and clearings.
    phase = rng.uniform(0.0, 2 * np.pi, (3, 1))
    waves = np.sin(phase + 2 * np.pi * s / np.array([[310.0], [137.0], [71.0]]) + side)
    stay = rng.uniform(0.0, 1.0, count) < 1.0 + theme.clearings * (waves.sum(axis=0) - 1.5)
    kinds = rng.choice(np.array(theme.trees), count)
    offset = side * (road.wall_offset + CLEAR_M + reach)
    size = rng.beta(2.0, 2.0, count)
    return s[stay], offset[stay], kinds[stay], size[stay], np.zeros(int(stay.sum()))


def _avenue(road: Road, theme: Theme, rng: np.random.Generator, *, tunnel: bool) -> Sites:
    """Return tall trees along both wall lines: the theme's kinds that give shade, or pines if it
    has none. With `tunnel` the rows are denser, and the crowns close over the road."""
    shady = [kind for kind in theme.trees if kind in SHADY] or ["pine"]
    step_m, overhang = (TUNNEL_STEP_M, TUNNEL_OVERHANG_M) if tunnel else (AVENUE_STEP_M, OVERHANG_M)
    step = road.track.length_m / max(1, round(road.track.length_m / step_m))
    s = np.tile(np.arange(0.0, road.track.length_m - 0.5 * step, step), 2)
    side = np.repeat([1.0, -1.0], len(s) // 2)
    s = s + step * (rng.uniform(-0.35, 0.35, len(s)) + 0.25 * side)
    offset = side * (road.wall_offset + CLEAR_M + rng.uniform(0.0, 2.5, len(s)))
    size = rng.uniform(0.65, 1.0, len(s))
    return s, offset, rng.choice(np.array(shady), len(s)), size, np.full(len(s), overhang)


def _tints(rng: np.random.Generator, sheds: NDArray[np.bool_], autumn: float) -> FloatArray:
    """Return random colour factors (N, 3). Of the trees marked in `sheds` (N,), the share 0.6 *
    `autumn` turns yellow or red; `autumn` is from 0 to 1."""
    count = len(sheds)
    tone = rng.uniform(0.7, 1.25, (count, 1))
    tint = tone * (1.0 + rng.uniform(-0.12, 0.12, (count, 3)))
    turned = sheds & (rng.uniform(0.0, 1.0, count) < 0.6 * autumn)
    tint[turned] *= np.array([2.0, 1.05, 0.5]) * rng.uniform(0.8, 1.1, (int(turned.sum()), 1))
    return tint
