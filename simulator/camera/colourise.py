"""Depth and class images in false colour, (height, width, 3) uint8 RGB."""

import cv2
import numpy as np
from numpy.typing import NDArray

from simulator.camera.core.render_modes import CLASS, CLASSES, DEPTH

Picture = NDArray[np.uint8]

CLASS_COLOURS: dict[str, tuple[int, int, int]] = {
    "road": (88, 88, 94),
    "marking": (250, 250, 250),
    "car": (222, 45, 38),
    "ground": (96, 148, 66),
    "sky": (128, 186, 255),
    "object": (232, 156, 30),
}
NEAREST_M, FARTHEST_M = 2.0, 500.0
"""Depths of the first and the last colour; the scale is logarithmic."""
_NO_DEPTH = (12, 12, 16)


def colourise(picture: NDArray[np.generic], kind: str) -> Picture:
    """`picture` of `kind` "depth" (red near, blue far, black the sky) or "class" (the palette
    CLASS_COLOURS) in colours; one of "colour" as it is."""
    if kind == DEPTH:
        return _depth_colours(np.asarray(picture, dtype=np.float64))
    if kind == CLASS:
        palette = np.array([CLASS_COLOURS[name] for name in CLASSES], dtype=np.uint8)
        return np.asarray(palette[np.asarray(picture, dtype=np.uint8)])
    return np.asarray(picture, dtype=np.uint8)


def _depth_colours(depth: NDArray[np.float64]) -> Picture:
    share = np.log(np.clip(depth, NEAREST_M, FARTHEST_M) / NEAREST_M)
    level = np.rint(255.0 * (1.0 - share / np.log(FARTHEST_M / NEAREST_M))).astype(np.uint8)
    colours = cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    return np.where(np.isinf(depth)[..., None], np.array(_NO_DEPTH), colours).astype(np.uint8)
