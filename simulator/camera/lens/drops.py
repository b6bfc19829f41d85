"""Rain drops on the windscreen, and the wiper that clears them. Pixels; no clock: the place along
the road sets how far the wiper is and how many drops have fallen since."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.camera.lens.cabin import REFERENCE_WIDTH
from simulator.varied.cabin import Cabin

Picture = NDArray[np.uint8]

STAGES = 3
"""Steps in which drops gather between two strokes of the wiper."""
SMALL = 4
"""A drop shows a wide view so small that this coarser picture of it is sharp enough."""
SWEEP = 0.3
"""Share of a wiper's period that its stroke takes."""
VIEW = 0.16
"""How far about itself a drop shows the picture, as a share of the width."""


@dataclass(frozen=True)
class _Drops:
    """Where each pixel looks in the small picture, and how much of a drop covers it (0 to 255)."""

    source_u: NDArray[np.float32]
    source_v: NDArray[np.float32]
    cover: Picture


class Windscreen:
    """Drops and wiper of one cabin before pictures of one size."""

    def __init__(self, cabin: Cabin, cover: float, wipes: bool, size: tuple[int, int]) -> None:
        """`cover`: share of the glass that drops cover at most; `size`: of pictures, (W, H)."""
        self._cabin, self._cover, self._wipes, self._size = cabin, cover, wipes, size
        width, height = size
        rng = np.random.default_rng([cabin.shape, 4])
        self._period_m = float(rng.uniform(14.0, 45.0))
        self._pivot = float(rng.uniform(0.1, 0.75)) * width, float(rng.uniform(1.15, 1.5)) * height
        self._kept: tuple[tuple[int, int], _Drops] | None = None

    def applied(self, picture: Picture, s: float) -> Picture:
        """`picture` seen through the wet glass at `s` (m) along the road."""
        turns, phase = divmod(s / self._period_m, 1.0)
        stroke, stage = (int(turns), int(phase * STAGES)) if self._wipes else (0, STAGES - 1)
        drops = self._drops(stroke, stage)
        width, height = self._size
        small = cv2.resize(
            picture, (-(-width // SMALL), -(-height // SMALL)), interpolation=cv2.INTER_AREA
        )
        seen = cv2.remap(
            small, drops.source_u, drops.source_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
        )
        wet = _blended(picture, np.asarray(seen, dtype=np.uint8), drops.cover)
        return self._wiped(wet, phase / SWEEP) if self._wipes and phase < SWEEP else wet

    def _wiped(self, picture: Picture, share: float) -> Picture:
        """The wiper's blade over `picture`, at `share` (0 to 1) of its stroke there and back."""
        width, height = self._size
        angle = math.radians(-85.0 + 170.0 * (1.0 - abs(2.0 * share - 1.0)))
        reach = 1.15 * height
        u, v = self._pivot
        tip = (round(u + reach * math.sin(angle)), round(v - reach * math.cos(angle)))
        mask = np.zeros((height, width), np.uint8)
        thick = max(1, round(0.018 * width))
        cv2.line(mask, (round(u), round(v)), tip, 235, thick, cv2.LINE_AA)
        mask = np.asarray(cv2.GaussianBlur(mask, (0, 0), 1.4 * width / REFERENCE_WIDTH), np.uint8)
        return _blended(picture, np.full_like(picture, 14), mask)

    def _drops(self, stroke: int, stage: int) -> _Drops:
        """The drops of one stroke at a stage; those of an earlier stage are among them."""
        if self._kept is None or self._kept[0] != (stroke, stage):
            rng = np.random.default_rng([self._cabin.shape, 5, stroke])
            share = (stage + 1) / STAGES
            self._kept = (stroke, stage), _fallen(self._cover, share, self._size, rng)
        return self._kept[1]


def _fallen(
    cover: float, share: float, size: tuple[int, int], rng: np.random.Generator
) -> _Drops:
    """The first `share` of drops that would cover about the share `cover` of a picture."""
    width, height = size
    scale = width / REFERENCE_WIDTH
    most = 400
    radius = np.clip(np.exp(rng.normal(0.7, 0.45, most)), 1.1, 9.0) * scale
    middle = rng.uniform(0.0, 1.0, (most, 2)) * (width, height)
    stretch = rng.uniform(1.0, 1.5, most)
    area = np.cumsum(np.pi * radius**2 * stretch)
    count = int(np.searchsorted(area, cover * share * width * height))
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    mask: FloatArray = np.zeros((height, width))
    for k in range(min(count, most)):
        _stamp((u, v), mask, middle[k], radius[k], radius[k] * stretch[k], VIEW * width)
    soft = cv2.GaussianBlur(mask, (0, 0), float(rng.uniform(0.4, 1.4)) * scale)
    return _Drops(u / SMALL, v / SMALL, np.rint(255.0 * soft).astype(np.uint8))


def _stamp(
    source: tuple[NDArray[np.float32], NDArray[np.float32]],
    mask: FloatArray,
    middle: FloatArray,
    half_u: float,
    half_v: float,
    view: float,
) -> None:
    """Write one drop: upside down, it shows the picture `view` pixels about it."""
    height, width = mask.shape
    left, right = max(int(middle[0] - half_u), 0), min(int(middle[0] + half_u) + 2, width)
    top, bottom = max(int(middle[1] - half_v), 0), min(int(middle[1] + half_v) + 2, height)
    if left >= right or top >= bottom:
        return
    x = (np.arange(left, right)[None, :] - middle[0]) / half_u
    y = (np.arange(top, bottom)[:, None] - middle[1]) / half_v
    off = x**2 + y**2
    inside = off < 1.0
    part = slice(top, bottom), slice(left, right)
    bent = 0.4 + 0.6 * off
    source[0][part] = np.where(inside, middle[0] - view * x * bent, source[0][part])
    source[1][part] = np.where(inside, middle[1] - view * y * bent, source[1][part])
    mask[part] = np.where(inside, 0.92, mask[part])


@compiled
def _blended(picture: Picture, other: Picture, cover: Picture) -> Picture:
    """`other` over `picture` where `cover` (H, W), 0 to 255, says how much."""
    out = picture.copy()
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            weight = np.int32(cover[v, u])
            if weight > 0:
                for c in range(3):
                    old, new = np.int32(out[v, u, c]), np.int32(other[v, u, c])
                    out[v, u, c] = old + (new - old) * weight // 255
    return out
