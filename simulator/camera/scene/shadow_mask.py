"""Shadows lying on the road: one mask over (s, y), 0 in the sun to 255 in the shade.

The mask reaches as far to both sides as the ribbon of the road does, and is centred on y = 0. It is
folded into bands of `BAND_TEXELS` along s, each with `GUARD` texels more on both sides, so that a
long track fits one texture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.camera.bridges.bridges import Bridge
from simulator.camera.bridges.shadow import cast_bridges
from simulator.camera.scene.land import Shadiness
from simulator.camera.scene.light import Light
from simulator.camera.scene.road_mesh import SKIRT_M
from simulator.camera.vegetation import canopy, foliage
from simulator.camera.vegetation.scenery import Trees
from simulator.track.road import Road

FloatArray = NDArray[np.float64]
Strip = NDArray[np.uint8]
"""An unfolded mask: (rows, columns), from right to left and once round the track."""

TEXEL_M = 0.25
GUARD, BAND_TEXELS = 8, 4080
LOOK_M = 30.0
LONGEST_SHADOW_M = 40.0
RUN_OUT_M = (2.0, 5.5)
"""From the wall line to where the mask begins, and ends, to run out into the land's shade."""


@dataclass(frozen=True)
class ShadeMask:
    """The mask `strip` and the same folded into `texels` (bands * rows, BAND_TEXELS + ...)."""

    strip: Strip
    texels: NDArray[np.uint8]
    along_m: float
    """Length of a texel along s, so that a whole number goes round the track."""

    def fraction(self, s: float, half_width: float) -> float:
        """Share in shadow of the road within `half_width` of its centre, LOOK_M ahead of s."""
        middle = self.strip.shape[0] // 2
        reach = min(int(half_width / TEXEL_M), middle)
        rows = self.strip[middle - reach : middle + reach]
        return float(_dark_share(rows, int(s / self.along_m), int(LOOK_M / self.along_m)))


@compiled
def _dark_share(rows: Strip, first: int, count: int) -> float:
    """Share of dark texels in `count` columns from `first` on, round the end of the strip."""
    dark, columns = 0, rows.shape[1]
    for row in rows:
        for k in range(first, first + count):
            dark += row[k % columns] >= 128
    return float(dark / (rows.shape[0] * count))


def build(
    road: Road,
    trees: Trees,
    bridges: Sequence[Bridge],
    land: Shadiness,
    light: Light,
    rng: np.random.Generator,
) -> ShadeMask:
    """The shadows of `light` on `road`: those of bridges and trees, or the hard case's canopy.

    Towards its sides the mask runs out into the shadiness of the `land` there, so that it ends in
    no line.
    """
    columns = max(GUARD, round(road.track.length_m / TEXEL_M))
    rows = 8 * int(np.ceil((road.wall_offset + SKIRT_M + 1.0) / TEXEL_M / 4.0))
    strip: Strip = np.zeros((rows, columns), dtype=np.uint8)
    along_m = road.track.length_m / columns
    if light.shade < 0.5:
        cast_bridges(strip, road, along_m, TEXEL_M, bridges, light)
        if light.canopy:
            strip = canopy.grown(strip, road, along_m, TEXEL_M, rng)
        else:
            _cast_trees(strip, road, along_m, trees, light)
        _run_out(strip, road, along_m, land)
    return ShadeMask(strip, _folded(strip), along_m)


def _run_out(strip: Strip, road: Road, along_m: float, land: Shadiness) -> None:
    """Let the mask run out into the land's smooth shade beyond the wall lines."""
    rows, columns = strip.shape
    begin, end = RUN_OUT_M
    y = (np.arange(rows) + 0.5 - rows / 2) * TEXEL_M
    share = np.clip((np.abs(y) - road.wall_offset - begin) / (end - begin), 0.0, 1.0).astype(
        np.float32
    )
    s = (np.arange(columns) + 0.5) * along_m
    for side, rim in ((1.0, y > 0), (-1.0, y < 0)):
        pose = road.track.at(s, side * (road.wall_offset + end))
        shade = land.at(pose.x, pose.y)
        # The value that road.frag.glsl's smoothstep(0.3, 0.7) turns into `shade`.
        level = 0.3 + 0.4 * (0.5 - np.sin(np.arcsin(1.0 - 2.0 * shade) / 3.0))
        part = np.flatnonzero(rim & (share > 0.0))
        weight = share[part, None]
        mixed = strip[part] * (1.0 - weight) + (255.0 * level[None]).astype(np.float32) * weight
        strip[part] = np.rint(mixed).astype(np.uint8)


def _folded(strip: Strip) -> NDArray[np.uint8]:
    columns = strip.shape[1]
    bands = -(-columns // BAND_TEXELS)
    first = BAND_TEXELS * np.arange(bands)[:, None] - GUARD
    pick = (first + np.arange(BAND_TEXELS + 2 * GUARD)) % columns
    return np.ascontiguousarray(
        strip[:, pick].transpose(1, 0, 2).reshape(-1, BAND_TEXELS + 2 * GUARD)
    )


def _cast_trees(strip: Strip, road: Road, along_m: float, trees: Trees, light: Light) -> None:
    """Lay each tree's outline on the road plane, away from the sun, where it reaches the road."""
    silhouettes = foliage.silhouettes()
    sx, sy, sz = light.sun_direction
    level = max(float(np.hypot(sx, sy)), 1e-6)
    length = np.minimum(trees.height * level / max(sz, 0.05), LONGEST_SHADOW_M)
    heading = road.track.at(trees.s).heading
    # The shadow's direction in the track frame at the tree's foot.
    ds = -(np.cos(heading) * sx + np.sin(heading) * sy) / level
    dy = -(-np.sin(heading) * sx + np.cos(heading) * sy) / level
    tip = trees.offset + length * dy
    limit = strip.shape[0] / 2 * TEXEL_M
    lands = (np.minimum(trees.offset, tip) - trees.width < limit) & (
        np.maximum(trees.offset, tip) + trees.width > -limit
    )
    for k in np.flatnonzero(lands):
        foot = np.array([trees.s[k] / along_m, trees.offset[k] / TEXEL_M + strip.shape[0] / 2])
        axis = np.array([ds[k] * length[k] / along_m, dy[k] * length[k] / TEXEL_M])
        across = np.array([-dy[k] / along_m, ds[k] / TEXEL_M]) * trees.width[k]
        _stamp(strip, silhouettes[trees.cell[k]], foot, axis, across)


def _stamp(
    strip: Strip, shape: NDArray[np.uint8], foot: FloatArray, axis: FloatArray, across: FloatArray
) -> None:
    """Draw `shape` (its foot at the bottom middle) over the parallelogram, keeping the darker."""
    corners = np.stack([foot - across / 2, foot + across / 2])
    corners = np.concatenate([corners, corners + axis])
    low = np.floor(corners.min(axis=0)).astype(int)
    high = np.ceil(corners.max(axis=0)).astype(int) + 1
    low[1], high[1] = max(low[1], 0), min(high[1], strip.shape[0])
    width, height = int(high[0] - low[0]), int(high[1] - low[1])
    if height <= 0 or width <= 0 or width > strip.shape[1]:
        return
    size = float(shape.shape[0])
    origin = foot - across / 2 + axis - low
    matrix = np.column_stack([across / size, -axis / size, origin])
    cast = cv2.warpAffine(shape, matrix, (width, height), flags=cv2.INTER_LINEAR)
    columns = np.arange(low[0], high[0]) % strip.shape[1]
    part = strip[low[1] : high[1], columns]
    strip[low[1] : high[1], columns] = np.maximum(part, cast)
