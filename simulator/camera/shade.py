"""Shadows lying on the road: one mask over (s, y), 0 in the sun to 255 in the shade.

The mask is folded into bands of `BAND_TEXELS` along s, each with `GUARD` texels more on both
sides, BAND_ROWS rows high and centred on y = 0, so that a long track fits one texture.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from simulator.camera import foliage
from simulator.camera.light import Light
from simulator.camera.scenery import Trees
from simulator.camera.terrain import CentreLine
from simulator.track.road import Road

FloatArray = NDArray[np.float64]
Strip = NDArray[np.uint8]
"""An unfolded mask: (BAND_ROWS, columns), from right to left and once round the track."""

TEXEL_M = 0.25
GUARD, BAND_ROWS, BAND_TEXELS = 8, 128, 4080
LOOK_M = 30.0
LONGEST_SHADOW_M = 40.0
WINDOW_M = 12.0
"""In the heavy-shadow light the covered share is set anew about every so many metres."""


@dataclass(frozen=True)
class ShadeMask:
    """The mask `strip` and the same folded into `texels` (bands * BAND_ROWS, BAND_TEXELS + ...)."""

    strip: Strip
    texels: NDArray[np.uint8]
    along_m: float
    """Length of a texel along s, so that a whole number goes round the track."""
    bands: int

    def fraction(self, s: float, half_width: float) -> float:
        """Share in shadow of the road within `half_width` of its centre, LOOK_M ahead of s."""
        columns = self.strip.shape[1]
        first = int(s / self.along_m)
        ahead = np.arange(first, first + int(LOOK_M / self.along_m)) % columns
        reach = min(int(half_width / TEXEL_M), BAND_ROWS // 2)
        middle = BAND_ROWS // 2
        part = self.strip[middle - reach : middle + reach, ahead]
        return float(np.mean(part >= 128))


def build(
    road: Road, line: CentreLine, trees: Trees, light: Light, rng: np.random.Generator
) -> ShadeMask:
    """The shadows of `light` on `road`: those of the trees, or the hard case's canopy."""
    columns = max(GUARD, round(road.track.length_m / TEXEL_M))
    strip: Strip = np.zeros((BAND_ROWS, columns), dtype=np.uint8)
    along_m = road.track.length_m / columns
    if light.kind == "heavy-shadow":
        strip = _canopy(road, along_m, columns, rng)
    elif light.shade < 0.5:
        _cast_trees(strip, road, along_m, trees, light)
    return ShadeMask(strip, _folded(strip), along_m, -(-columns // BAND_TEXELS))


def _folded(strip: Strip) -> NDArray[np.uint8]:
    columns = strip.shape[1]
    bands = -(-columns // BAND_TEXELS)
    first = BAND_TEXELS * np.arange(bands)[:, None] - GUARD
    pick = (first + np.arange(BAND_TEXELS + 2 * GUARD)) % columns
    return np.ascontiguousarray(
        strip[:, pick].transpose(1, 0, 2).reshape(bands * BAND_ROWS, BAND_TEXELS + 2 * GUARD)
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
    limit = road.wall_offset + 2.0
    lands = (np.minimum(trees.offset, tip) - trees.width < limit) & (
        np.maximum(trees.offset, tip) + trees.width > -limit
    )
    for k in np.flatnonzero(lands):
        foot = np.array([trees.s[k] / along_m, trees.offset[k] / TEXEL_M + BAND_ROWS / 2])
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


def _canopy(road: Road, along_m: float, columns: int, rng: np.random.Generator) -> Strip:
    """Dappled shade of trees that meet over the road, and of a bridge now and then.

    A noise field is cut at a level found anew every WINDOW_M so that the covered share of the
    asphalt is what was drawn for that place: between 0.38 and 0.66, over any 30 m between 0.3 and
    0.8 with the bridges.
    """
    field = _blobs(columns, along_m, rng)
    half = round(road.half_asphalt / TEXEL_M)
    middle = BAND_ROWS // 2
    asphalt = field[middle - half : middle + half]
    window = max(1, round(WINDOW_M / along_m))
    count = max(3, columns // window)
    centres = (np.arange(count) + 0.5) * columns / count
    wanted = rng.uniform(0.40, 0.64, count)
    wanted = 0.25 * np.roll(wanted, 1) + 0.5 * wanted + 0.25 * np.roll(wanted, -1)
    edges = np.linspace(0, columns, count + 1).astype(int)
    level = [
        float(np.quantile(asphalt[:, a:b], 1.0 - share))
        for a, b, share in zip(edges[:-1], edges[1:], wanted, strict=True)
    ]
    cut = np.interp(np.arange(columns), centres, level, period=columns)
    soft = np.clip((field - cut) * 9.0 + 0.5, 0.0, 1.0)
    strip: Strip = np.rint(soft * 255.0).astype(np.uint8)
    for start in _bridges(columns * along_m, rng):
        a, b = int(start / along_m), int((start + rng.uniform(4.0, 7.0)) / along_m)
        strip[:, a:b] = 255
    return strip


def _blobs(columns: int, along_m: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """A field of leaf clumps and boughs (BAND_ROWS, columns), standard deviation 1."""
    field = np.zeros((BAND_ROWS, columns), dtype=np.float32)
    for size_m, weight in ((3.2, 1.0), (1.3, 0.55), (0.55, 0.3)):
        noise = rng.standard_normal(field.shape).astype(np.float32)
        smooth = cv2.GaussianBlur(
            noise, (0, 0), size_m / 2.0 / along_m, sigmaY=size_m / 2.4 / TEXEL_M,
            borderType=cv2.BORDER_REFLECT,
        )  # fmt: skip
        field += weight * smooth / max(float(smooth.std()), 1e-6)
    return np.asarray(field / max(float(field.std()), 1e-6), dtype=np.float32)


def _bridges(length_m: float, rng: np.random.Generator) -> list[float]:
    count = int(length_m / 400.0)
    return sorted(float(s) for s in rng.uniform(20.0, max(length_m - 40.0, 21.0), count))
