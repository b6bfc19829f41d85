"""Draws rain drops on the windscreen, and the wiper that clears them, into pictures.

There is no clock. The position along the road determines the position of the wiper, and the number
of drops that have fallen since the wiper's last stroke. Coordinates are in pixels.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.camera.lens.cabin import REFERENCE_WIDTH
from simulator.varied.look import Cabin

Picture = NDArray[np.uint8]

STAGES = 3
"""Number of stages in which drops accumulate between two strokes of the wiper."""
SMALL = 4
"""Factor by which the picture seen through drops is reduced. Drops show the picture much smaller,
so the reduced resolution is sufficient."""
SWEEP = 0.3
"""Duration of the wiper's stroke as a share of its period."""
MOST_DROPS = 400
OPACITY = 235
"""Opacity of a drop, 0 to 255."""
BLADE = 14
"""Grey value of the wiper, 0 to 255."""
VIEW = 0.16
"""Radius of the part of the picture that a drop shows, as a share of the picture's width."""


@dataclass(frozen=True)
class _Drops:
    """The N pixels that drops cover. `pixel`: row-major index of each pixel; `source`: index of the
    pixel of the small picture that it shows; `cover`: opacity of the drop there, 0 to 255."""

    pixel: NDArray[np.int32]
    source: NDArray[np.int32]
    cover: Picture


class Windscreen:
    """Draws the rain drops and the wiper of one car's windscreen into pictures of one size."""

    def __init__(self, cabin: Cabin, cover: float, wipes: bool, size: tuple[int, int]) -> None:
        """`cover` is the largest share (0 to 1) of the glass that drops cover, `wipes` whether the
        wiper moves, `size` the width and height of the pictures, px."""
        self._cabin, self._cover, self._wipes, self._size = cabin, cover, wipes, size
        width, height = size
        rng = np.random.default_rng([cabin.shape, 4])
        self._period_m = float(rng.uniform(14.0, 45.0))
        self._pivot = float(rng.uniform(0.1, 0.75)) * width, float(rng.uniform(1.15, 1.5)) * height
        self._kept: tuple[tuple[int, int], _Drops] | None = None

    def applied(self, picture: Picture, s: float) -> Picture:
        """Return `picture` (H, W, 3) seen through the wet glass at `s` (m) along the road."""
        turns, phase = divmod(s / self._period_m, 1.0)
        stroke, stage = (int(turns), int(phase * STAGES)) if self._wipes else (0, STAGES - 1)
        drops = self._drops(stroke, stage)
        small = cv2.resize(picture, _small(self._size), interpolation=cv2.INTER_AREA)
        wet = _through(picture, np.asarray(small, np.uint8), drops.pixel, drops.source, drops.cover)
        if self._wipes and phase < SWEEP:
            self._wipe(wet, phase / SWEEP)
        return wet

    def _wipe(self, picture: Picture, share: float) -> None:
        """Draw the wiper's blade over `picture`, in place. `share` (0 to 1) is the completed part
        of a stroke, which consists of the way there and the way back."""
        width, height = self._size
        angle = math.radians(-85.0 + 170.0 * (1.0 - abs(2.0 * share - 1.0)))
        reach = 1.15 * height
        u, v = self._pivot
        tip = (round(u + reach * math.sin(angle)), round(v - reach * math.cos(angle)))
        mask = np.zeros((height, width), np.uint8)
        thick = max(1, round(0.018 * width))
        cv2.line(mask, (round(u), round(v)), tip, 235, thick, cv2.LINE_AA)
        soft = 2 * round(1.5 * width / REFERENCE_WIDTH) + 1
        _darken(picture, np.asarray(cv2.blur(mask, (soft, soft)), np.uint8), BLADE)

    def _drops(self, stroke: int, stage: int) -> _Drops:
        """Return the drops at a stage of one stroke, including the drops of earlier stages."""
        if self._kept is None or self._kept[0] != (stroke, stage):
            rng = np.random.default_rng([self._cabin.shape, 5, stroke])
            share = (stage + 1) / STAGES
            self._kept = (stroke, stage), _fallen(self._cover, share, self._size, rng)
        return self._kept[1]


def _small(size: tuple[int, int]) -> tuple[int, int]:
    """Return width and height (px) of the reduced picture that drops show, for a picture of `size`
    (width, height), px."""
    return -(-size[0] // SMALL), -(-size[1] // SMALL)


def _fallen(cover: float, share: float, size: tuple[int, int], rng: np.random.Generator) -> _Drops:
    """Return the drops that have fallen when the share `share` (0 to 1) of a random sequence of
    drops has fallen. The whole sequence covers the share `cover` of a picture of `size` (width,
    height), px."""
    width, height = size
    scale = width / REFERENCE_WIDTH
    radius = np.clip(np.exp(rng.normal(0.7, 0.45, MOST_DROPS)), 1.1, 9.0) * scale
    middle = rng.uniform(0.0, 1.0, (MOST_DROPS, 2)) * (width, height)
    tall = radius * rng.uniform(1.0, 1.5, MOST_DROPS)
    area = np.cumsum(np.pi * radius * tall)
    count = int(np.searchsorted(area, cover * share * width * height))
    shape = np.column_stack([middle, radius, tall])[:count]
    mask, source = _stamped(shape, width, height, VIEW * width)
    soft = cv2.GaussianBlur(mask, (0, 0), float(rng.uniform(0.4, 1.0)) * scale)
    # The blurred edge reaches outside the drops; pixels there show no drop and are left out.
    pixel = np.flatnonzero(mask).astype(np.int32)
    return _Drops(pixel, source.reshape(-1)[pixel], np.asarray(soft, np.uint8).reshape(-1)[pixel])


@compiled
def _stamped(
    shape: FloatArray, width: int, height: int, view: float
) -> tuple[Picture, NDArray[np.int32]]:
    """Return the opacity (H, W) of the drops, and for each covered pixel the index (H, W) of the
    pixel of the small picture that it shows.

    `shape` (N, 4): middle and half axes of each drop, px. A drop shows the part of the picture
    within `view` px of its middle, upside down.
    """
    mask = np.zeros((height, width), np.uint8)
    source = np.zeros((height, width), np.int32)
    across, down = (width + SMALL - 1) // SMALL, (height + SMALL - 1) // SMALL
    for k in range(len(shape)):
        u0, v0, half_u, half_v = shape[k]
        for v in range(max(int(v0 - half_v), 0), min(int(v0 + half_v) + 2, height)):
            for u in range(max(int(u0 - half_u), 0), min(int(u0 + half_u) + 2, width)):
                x, y = (u - u0) / half_u, (v - v0) / half_v
                off = x * x + y * y
                if off < 1.0:
                    bent = view * (0.4 + 0.6 * off) / SMALL
                    a = min(max(int(u0 / SMALL - x * bent), 0), across - 1)
                    b = min(max(int(v0 / SMALL - y * bent), 0), down - 1)
                    mask[v, u], source[v, u] = OPACITY, b * across + a
    return mask, source


@compiled
def _through(
    picture: Picture,
    small: Picture,
    pixel: NDArray[np.int32],
    source: NDArray[np.int32],
    cover: Picture,
) -> Picture:
    """Return a copy of `picture` with the drops drawn into it. `small` is the reduced picture that
    drops show; `pixel`, `source` and `cover` are the fields of `_Drops`."""
    out = picture.copy()
    flat, seen = out.reshape(-1, 3), small.reshape(-1, 3)
    for k in range(len(pixel)):
        weight = np.int32(cover[k])
        for c in range(3):
            old, new = np.int32(flat[pixel[k], c]), np.int32(seen[source[k], c])
            flat[pixel[k], c] = old + (new - old) * weight // 255
    return out


@compiled
def _darken(picture: Picture, cover: Picture, value: int) -> None:
    """Draw the grey `value` over `picture`, in place, with the opacity `cover` (H, W), 0 to 255."""
    for v in range(picture.shape[0]):
        for u in range(picture.shape[1]):
            weight = np.int32(cover[v, u])
            if weight > 0:
                for c in range(3):
                    old = np.int32(picture[v, u, c])
                    picture[v, u, c] = old + (value - old) * weight // 255
