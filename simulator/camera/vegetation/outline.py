"""Outlines of tree pictures: few corners round all that is not clear, so that little else is drawn.

Corner frame of a picture: x from -0.5 to 0.5, y from 0 (foot) to 1, as the tree's shader has it.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

CORNERS = 6
_BLEED = 4
"""Texels by which smaller versions of a picture spread; the outline keeps so far off."""


def outline(alpha: NDArray[np.uint8]) -> FloatArray:
    """A convex polygon (CORNERS, 2) round the picture of `alpha` (size, size), within its cell."""
    size = alpha.shape[0]
    spread = cv2.dilate((alpha > 0).astype(np.uint8), np.ones((2 * _BLEED + 1,) * 2, np.uint8))
    points = cv2.findNonZero(spread).reshape(-1, 2)
    # A texel is a square: all four of its corners must be inside.
    squares = np.concatenate(
        [points + np.array(shift) for shift in ((0, 0), (1, 0), (0, 1), (1, 1))]
    )
    hull = cv2.convexHull(squares.astype(np.int32)).reshape(-1, 2) / size
    polygon = np.column_stack([hull[:, 0] - 0.5, 1.0 - hull[:, 1]])
    while len(polygon) > CORNERS:
        polygon = _one_fewer(polygon)
    return np.concatenate([polygon, np.repeat(polygon[-1:], CORNERS - len(polygon), axis=0)])


def _one_fewer(polygon: FloatArray) -> FloatArray:
    """The polygon with the edge taken out that costs the least area: its neighbours are drawn on
    until they meet."""
    best, least = polygon, np.inf
    for k in range(len(polygon)):
        before, a, b, after = (polygon[(k + shift) % len(polygon)] for shift in (-1, 0, 1, 2))
        meeting = _meeting(before, a, after, b)
        if meeting is None or np.abs(meeting - [0.0, 0.5]).max() > 0.5:
            continue
        area = abs(_cross(b - a, meeting - a))
        if area < least:
            kept = np.delete(polygon, (k + 1) % len(polygon), axis=0)
            kept[k - (k == len(polygon) - 1)] = meeting
            best, least = kept, area
    if best is polygon:  # no two edges meet within the cell: the cell itself does
        return np.array([[-0.5, 0.0], [0.5, 0.0], [0.5, 1.0], [-0.5, 1.0]])
    return best


def _meeting(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray | None:
    """Where the lines from a through b and from c through d meet beyond b and d."""
    u, v = b - a, d - c
    slope = _cross(u, v)
    if abs(slope) < 1e-12:
        return None
    share, other = _cross(c - a, v) / slope, _cross(c - a, u) / slope
    return np.asarray(a + share * u) if share >= 1.0 and other >= 1.0 else None


def _cross(a: FloatArray, b: FloatArray) -> float:
    return float(a[0] * b[1] - a[1] * b[0])
