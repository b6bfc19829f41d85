"""Overlap test of cars as rectangles in the plane. World frame, metres, radians."""

import math

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled

FloatArray = NDArray[np.float64]


@compiled
def boxes_overlap(a: FloatArray, b: FloatArray) -> bool:
    """Whether two boxes (x, y, yaw, length, width) overlap, by the separating-axis theorem."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    turn = b[2] - a[2]
    cos, sin = abs(math.cos(turn)), abs(math.sin(turn))
    for yaw, own, other in ((a[2], a, b), (b[2], b, a)):
        along = abs(dx * math.cos(yaw) + dy * math.sin(yaw))
        across = abs(-dx * math.sin(yaw) + dy * math.cos(yaw))
        if along > 0.5 * (own[3] + other[3] * cos + other[4] * sin):
            return False
        if across > 0.5 * (own[4] + other[3] * sin + other[4] * cos):
            return False
    return True


@compiled
def first_overlap(boxes: FloatArray) -> tuple[int, int]:
    """Indices of the first pair of `boxes` (n, 5) that overlap, (-1, -1) if none do."""
    for i in range(boxes.shape[0]):
        for j in range(i + 1, boxes.shape[0]):
            reach = boxes[i, 3] + boxes[j, 3]
            near = abs(boxes[i, 0] - boxes[j, 0]) < reach and abs(boxes[i, 1] - boxes[j, 1]) < reach
            if near and boxes_overlap(boxes[i], boxes[j]):
                return i, j
    return -1, -1
