"""The hard case's shade: trees that meet over the road and let dapples of sun through."""

import cv2
import numpy as np
from numpy.typing import NDArray

from simulator.track.road import Road

Strip = NDArray[np.uint8]

WINDOW_M = 12.0
"""The covered share is set anew about every so many metres."""
THINS_OUT_M = 5.0
"""Beyond the wall line the clumps grow smaller over so many metres, and end."""
SHARE = (0.40, 0.64)
"""Bounds of the covered share of the asphalt in a window, bridges included."""


def grown(
    bridged: Strip, road: Road, along_m: float, texel_m: float, rng: np.random.Generator
) -> Strip:
    """The mask `bridged` (rows, columns), which holds the bridges' shadows, with a canopy added.

    A noise field is cut at a level found anew every WINDOW_M so that the covered share of the
    asphalt is what was drawn for that place; where a bridge covers more, the canopy stays away.
    Over any 30 m the share lies between 0.3 and 0.8.
    """
    rows, columns = bridged.shape
    field = _blobs(rows, columns, along_m, texel_m, rng)
    half = round(road.half_asphalt / texel_m)
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
    y = (np.arange(rows) + 0.5 - rows / 2) * texel_m
    ends = 2.6 * np.clip((np.abs(y) - road.wall_offset + 1.0) / THINS_OUT_M, 0.0, 1.0)
    field -= ends[:, None].astype(np.float32)
    cut = np.interp(np.arange(columns), centres, level, period=columns).astype(np.float32)
    soft = np.clip((field - cut) * np.float32(9.0 * 255.0) + np.float32(128.0), 0.0, 255.0)
    return np.asarray(np.maximum(soft.astype(np.uint8), bridged), dtype=np.uint8)


def _blobs(
    rows: int, columns: int, along_m: float, texel_m: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """A field of leaf clumps and boughs (rows, columns), standard deviation 1."""
    field = np.zeros((rows, columns), dtype=np.float32)
    # Clumps need no noise finer than they are.
    for size_m, weight, coarse in ((3.2, 1.0, 4), (1.3, 0.55, 2), (0.55, 0.3, 1)):
        noise = rng.standard_normal((-(-rows // coarse), -(-columns // coarse)), dtype=np.float32)
        smooth = cv2.GaussianBlur(
            noise, (0, 0), size_m / 2.0 / along_m / coarse, sigmaY=size_m / 2.4 / texel_m / coarse,
            borderType=cv2.BORDER_REFLECT,
        )  # fmt: skip
        smooth = cv2.resize(smooth, (columns, rows), interpolation=cv2.INTER_LINEAR)
        field += np.float32(weight / max(float(smooth.std()), 1e-6)) * smooth
    return np.asarray(field / max(float(field.std()), 1e-6), dtype=np.float32)
