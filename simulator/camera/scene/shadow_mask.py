"""Shadows of bridges and trees on the road: a mask over (s, y), from 0 in the sun to 255 in shadow.

The mask is as wide as the road mesh and centred on y = 0. It is cut along s into bands of 4080
texels, stacked so that a long track fits one texture. Each band has 8 additional texels at both
ends.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.camera.bridges.bridges import Bridge
from simulator.camera.scene.land import TreeShade
from simulator.camera.scene.light import Light
from simulator.camera.scene.road_mesh import SKIRT_M
from simulator.camera.vegetation import foliage
from simulator.camera.vegetation.scenery import Trees
from simulator.track.road import Road

Strip = NDArray[np.uint8]
"""A mask that is not cut into bands (rows, columns): rows from right to left across the road,
columns once round the track."""

TEXEL_M = 0.25
GUARD, BAND_TEXELS = 8, 4080
LOOK_M = 30.0
LONGEST_SHADOW_M = 40.0
RUN_OUT_M = (2.0, 5.5)
"""Distances from the wall line between which the mask fades into the shade of the terrain."""
WINDOW_M = 12.0
"""Length of a window of the canopy; each window has its own covered share."""
THINS_OUT_M = 5.0
"""Distance beyond the wall line over which the canopy fades to nothing."""
SHARE = (0.40, 0.64)
"""Bounds of the covered share of the asphalt in a window, including shadows of bridges."""
FINE = 2
"""Rays per texel in each direction; their mean smooths the shadow's edge over a texel."""
ROAD_Z_M = 2.5
"""Largest height (m) of a bridge's origin above a part of the road on which its shadow can fall."""
FARTHEST_M = 70.0
SKY_BLUR_M = 3.0
"""Distance beyond a bridge's edges within which the bridge hides a part of the sky."""


@dataclass(frozen=True)
class ShadowMask:
    """The mask as one `strip` (rows, columns) along the track, and as the texture `texels`
    (bands * rows, 4096), in which the bands are stacked. On roads of `--roads varied` the texels
    have a second component, the share of the sky that bridges hide, 0 to 255."""

    strip: Strip
    texels: NDArray[np.uint8]
    along_m: float
    """Length of a texel along s; the track's length is a whole number of texels."""

    def fraction(self, s: float, half_width: float) -> float:
        """Return the shadowed share (0 to 1) of the road within `half_width` (m) of its centre,
        from `s` (m) to 30 m farther."""
        middle = self.strip.shape[0] // 2
        reach = min(int(half_width / TEXEL_M), middle)
        rows = self.strip[middle - reach : middle + reach]
        return float(_dark_share(rows, int(s / self.along_m), int(LOOK_M / self.along_m)))


@compiled
def _dark_share(rows: Strip, first: int, count: int) -> float:
    """Return the share of dark texels in `count` columns of `rows` from the column `first` on. The
    columns wrap round the track."""
    dark, columns = 0, rows.shape[1]
    for row in rows:
        for k in range(first, first + count):
            dark += row[k % columns] >= 128
    return float(dark / (rows.shape[0] * count))


def build(
    road: Road,
    trees: Trees,
    bridges: Sequence[Bridge],
    land: TreeShade,
    light: Light,
    rng: np.random.Generator,
    *,
    sky: bool = False,
) -> ShadowMask:
    """Compute the shadows on `road` in `light`. Bridges cast shadows, and so do trees or, in the
    light "heavy-shadow", a closed canopy. If `sky`, the share of the sky that bridges hide is
    computed too.

    At its sides the mask fades into `land`, the trees' shade on the terrain, so that no edge is
    visible.
    """
    columns = max(GUARD, round(road.track.length_m / TEXEL_M))
    rows = 8 * int(np.ceil((road.wall_offset + SKIRT_M + 1.0) / TEXEL_M / 4.0))
    strip: Strip = np.zeros((rows, columns), dtype=np.uint8)
    along_m = road.track.length_m / columns
    if light.shade < 0.5:
        cast_bridges(strip, road, along_m, bridges, light)
        if light.canopy:
            strip = _with_canopy(strip, road, along_m, rng)
        else:
            _cast_trees(strip, road, along_m, trees, light)
        _run_out(strip, road, along_m, land)
    texels = _folded(strip)
    if sky:
        hidden = _folded(_hidden_sky(strip.shape, road, along_m, bridges, light))
        texels = np.dstack([texels, hidden])
    return ShadowMask(strip, texels, along_m)


def _hidden_sky(
    shape: tuple[int, ...], road: Road, along_m: float, bridges: Sequence[Bridge], light: Light
) -> Strip:
    """Return the share (rows, columns) of the sky that bridges hide, 0 to 255: the footprints of
    the bridges, blurred over SKY_BLUR_M. `shape` is (rows, columns); `along_m` is the length (m) of
    a texel along the road."""
    below: Strip = np.zeros(shape, dtype=np.uint8)
    cast_bridges(below, road, along_m, bridges, replace(light, sun_elevation=math.pi / 2))
    size = (2 * round(SKY_BLUR_M / along_m) + 1, 2 * round(SKY_BLUR_M / TEXEL_M) + 1)
    return np.asarray(cv2.blur(below, size, borderType=cv2.BORDER_REPLICATE), dtype=np.uint8)


def _run_out(strip: Strip, road: Road, along_m: float, land: TreeShade) -> None:
    """Fade the mask `strip`, in place, into `land`, the smooth shade of the terrain, beyond the
    wall lines. `along_m` is the length (m) of a texel along the road."""
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
        # `level` is the value that road.frag.glsl's smoothstep(0.3, 0.7) turns into `shade`.
        level = 0.3 + 0.4 * (0.5 - np.sin(np.arcsin(1.0 - 2.0 * shade) / 3.0))
        part = np.flatnonzero(rim & (share > 0.0))
        weight = share[part, None]
        mixed = strip[part] * (1.0 - weight) + (255.0 * level[None]).astype(np.float32) * weight
        strip[part] = np.rint(mixed).astype(np.uint8)


def _folded(strip: Strip) -> NDArray[np.uint8]:
    """Return the texels (bands * rows, BAND_TEXELS + 2 GUARD) of the unfolded mask `strip`."""
    columns = strip.shape[1]
    bands = -(-columns // BAND_TEXELS)
    first = BAND_TEXELS * np.arange(bands)[:, None] - GUARD
    pick = (first + np.arange(BAND_TEXELS + 2 * GUARD)) % columns
    return np.ascontiguousarray(
        strip[:, pick].transpose(1, 0, 2).reshape(-1, BAND_TEXELS + 2 * GUARD)
    )


def _cast_trees(strip: Strip, road: Road, along_m: float, trees: Trees, light: Light) -> None:
    """Add to `strip`, in place, the shadow of each tree whose shadow reaches the road: its
    silhouette, projected onto the road plane. `along_m` is the length (m) of a texel along the
    road."""
    silhouettes = foliage.silhouettes()
    sx, sy, sz = light.sun_direction
    level = max(float(np.hypot(sx, sy)), 1e-6)
    length = np.minimum(trees.height * level / max(sz, 0.05), LONGEST_SHADOW_M)
    heading = road.track.at(trees.s).heading
    # Direction of the shadow in the track frame at the tree's foot.
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
    """Draw `shape`, a silhouette with its foot in the middle of the last row, into a parallelogram
    of `strip`, in place. Each texel keeps the darker value. `foot`, `axis` (from foot to tip) and
    `across` (the whole width) are (column, row) in texels."""
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


def _with_canopy(bridged: Strip, road: Road, along_m: float, rng: np.random.Generator) -> Strip:
    """Return the mask `bridged` (rows, columns) of bridge shadows with a canopy added. `along_m` is
    the length (m) of a texel along the road.

    The canopy is a thresholded noise field. The threshold of each window of WINDOW_M is chosen so
    that the covered share of the asphalt equals a random share. If a bridge covers more than this
    share, no canopy is added. Over any 30 m the covered share lies between 0.3 and 0.8.
    """
    rows, columns = bridged.shape
    field = _blobs(rows, columns, along_m, rng)
    half = round(road.half_asphalt / TEXEL_M)
    asphalt = slice(rows // 2 - half, rows // 2 + half)
    count = max(3, columns // max(1, round(WINDOW_M / along_m)))
    centres = (np.arange(count) + 0.5) * columns / count
    wanted = rng.uniform(*SHARE, count)
    wanted = 0.25 * np.roll(wanted, 1) + 0.5 * wanted + 0.25 * np.roll(wanted, -1)
    edges = np.linspace(0, columns, count + 1).astype(int)
    level = []
    for a, b, share in zip(edges[:-1], edges[1:], wanted, strict=True):
        sunny = bridged[asphalt, a:b] < 128
        left = 1.0 - float(sunny.mean())
        rest = np.clip((share - left) / max(1.0 - left, 1e-6), 0.02, 1.0)
        part = field[asphalt, a:b]
        level.append(float(np.quantile(part[sunny] if sunny.any() else part, 1.0 - rest)))
    y = (np.arange(rows) + 0.5 - rows / 2) * TEXEL_M
    ends = 2.6 * np.clip((np.abs(y) - road.wall_offset + 1.0) / THINS_OUT_M, 0.0, 1.0)
    field -= ends[:, None].astype(np.float32)
    cut = np.interp(np.arange(columns), centres, level, period=columns).astype(np.float32)
    soft = np.clip((field - cut) * np.float32(9.0 * 255.0) + np.float32(128.0), 0.0, 255.0)
    return np.asarray(np.maximum(soft.astype(np.uint8), bridged), dtype=np.uint8)


def _blobs(
    rows: int, columns: int, along_m: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Return a noise field (rows, columns) of leaf clumps and boughs with standard deviation 1.
    `along_m` is the length (m) of a texel along the road."""
    field = np.zeros((rows, columns), dtype=np.float32)
    # Large clumps need only coarse noise.
    for size_m, weight, coarse in ((3.2, 1.0, 4), (1.3, 0.55, 2), (0.55, 0.3, 1)):
        noise = rng.standard_normal((-(-rows // coarse), -(-columns // coarse)), dtype=np.float32)
        smooth = cv2.GaussianBlur(
            noise, (0, 0), size_m / 2.0 / along_m / coarse, sigmaY=size_m / 2.4 / TEXEL_M / coarse,
            borderType=cv2.BORDER_REFLECT,
        )  # fmt: skip
        smooth = cv2.resize(smooth, (columns, rows), interpolation=cv2.INTER_LINEAR)
        field += np.float32(weight / max(float(smooth.std()), 1e-6)) * smooth
    return np.asarray(field / max(float(field.std()), 1e-6), dtype=np.float32)


def cast_bridges(
    strip: Strip,
    road: Road,
    along_m: float,
    bridges: Sequence[Bridge],
    light: Light,
) -> None:
    """Darken the texels of `strip` (rows, columns), in place, from which a bridge hides the sun.
    `along_m` is the length (m) of a texel along the road."""
    for bridge in bridges:
        sun = bridge.turned(np.array(light.sun_direction))
        low, high = _reach(bridge.boxes, sun)
        # On the inside of a bend 1 m of s is shorter on the ground, so the range of s is longer.
        bend = 1.0 / max(0.5, 1.0 - abs(road.track.curvature(bridge.s)) * road.wall_offset)
        first = int((bridge.s + max(low * bend, -FARTHEST_M)) / along_m) - 8
        last = int((bridge.s + min(high * bend, FARTHEST_M)) / along_m) + 9
        dark = _darkened(bridge, road, along_m, (first, last), strip.shape[0], sun)
        columns = np.arange(first, last) % strip.shape[1]
        strip[:, columns] = np.maximum(strip[:, columns], dark)


def _reach(boxes: FloatArray, sun: FloatArray) -> tuple[float, float]:
    """Return where the shadows of `boxes` begin and end along the road, in m from the bridge. `sun`
    (3,) is the direction to the sun in the bridge's frame."""
    drop = boxes[:, 1, 2] + ROAD_Z_M
    shift = -sun[0] / max(sun[2], 1e-3) * drop
    low = np.minimum(boxes[:, 0, 0], boxes[:, 0, 0] + shift)
    high = np.maximum(boxes[:, 1, 0], boxes[:, 1, 0] + shift)
    return float(low.min()), float(high.max())


def _darkened(
    bridge: Bridge,
    road: Road,
    along_m: float,
    columns: tuple[int, int],
    rows: int,
    sun: FloatArray,
) -> Strip:
    """Return the shadow (rows, columns) of one bridge, 0 to 255, on the columns `columns` (first,
    last) of the unfolded mask. The columns may lie beyond the ends of the mask. `along_m` is the
    length (m) of a texel along the road, `sun` (3,) the direction to the sun in the bridge's
    frame."""
    first, last = columns
    s = (first + (np.arange((last - first) * FINE) + 0.5) / FINE) * along_m
    y = ((np.arange(rows * FINE) + 0.5) / FINE - rows / 2) * TEXEL_M
    pose = road.track.at(s[None, :] % road.track.length_m, y[:, None])
    own = bridge.inside(np.stack(np.broadcast_arrays(pose.x, pose.y, pose.z), axis=-1))
    slope = np.where(np.abs(sun) > 1e-6, sun, 1e-6)
    reached = [np.ascontiguousarray(own[..., k] / slope[k], dtype=np.float32) for k in range(3)]
    hidden = np.zeros(own.shape[:2], dtype=np.bool_)
    for box in bridge.boxes:
        hidden |= _hit(reached, box / slope)
    shares = hidden.reshape(rows, FINE, last - first, FINE).mean(axis=(1, 3))
    return np.asarray(np.rint(255.0 * shares), dtype=np.uint8)


def _hit(reached: list[NDArray[np.float32]], box: FloatArray) -> NDArray[np.bool_]:
    """Return a mask of the points `reached` from which a ray towards the sun meets a `box` (slab
    method).

    The coordinates of the points (three arrays x, y, z) and of the box (2, 3) are each divided by
    the component of the ray's direction along the same axis.
    """
    enter = np.zeros_like(reached[0])
    leave = np.full_like(reached[0], np.inf)
    for axis, place in enumerate(reached):
        np.maximum(enter, np.float32(box[:, axis].min()) - place, out=enter)
        np.minimum(leave, np.float32(box[:, axis].max()) - place, out=leave)
    return np.asarray(enter < leave)
