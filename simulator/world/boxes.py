"""Boxes around cars and in walls, and a test whether two of them overlap, in compiled code.

A box is an array (15,): centre (m), its three axes as rows of unit vectors, half extents along the
axes (m). World frame, z up. `p` is the record `CarParameters.packed()[0]`.
"""

import math
from typing import Any

import numpy as np

from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.vehicle.orientation import rotation

CENTRE, AXES, HALF, BOX = 0, 3, 12, 15
GROUND_CLEARANCE_M = 0.12
"""Distance (m) from the road to the underside of a car's box."""


@compiled
def box_height(height: float, cg_height: float) -> tuple[float, float]:
    """Return half the height of a car's box, and the height of the box's centre over the centre of
    gravity, in m. `height` is the car's height, `cg_height` the height of its centre of gravity, in
    m."""
    half = 0.5 * (height - GROUND_CLEARANCE_M)
    return half, GROUND_CLEARANCE_M + half - cg_height


@compiled
def box_radius(p: Any) -> float:
    """Return the largest distance (m) of a point of a car's box from its centre of gravity."""
    half, above = box_height(p.height, p.cg_height)
    return math.sqrt(0.25 * (p.length**2 + p.width**2) + (half + abs(above)) ** 2)


@compiled
def fill_car_box(p: Any, motion: FloatArray, box: FloatArray) -> None:
    """Fill `box` (15,) with the box of a car with the parameters `p` and `motion` (13,): position,
    quaternion (x, y, z, w), velocity, angular velocity."""
    half, above = box_height(p.height, p.cg_height)
    axes = rotation(motion[3:7])
    for i in range(3):
        box[CENTRE + i] = motion[i] + above * axes[2, i]
        for j in range(3):
            box[AXES + 3 * i + j] = axes[i, j]
    box[HALF], box[HALF + 1], box[HALF + 2] = 0.5 * p.length, 0.5 * p.width, half


@compiled
def boxes_overlap(a: FloatArray, b: FloatArray, margin: float) -> bool:
    """Return whether the gap between the boxes `a` and `b` (15,) is at most `margin` m along every
    separating axis.

    Method: the separating-axis theorem for oriented boxes (Gottschalk et al., OBBTree, SIGGRAPH
    1996). With a margin of 0 the boxes overlap or touch.
    """
    cosines, across = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        across[i] = 0.0
        for k in range(3):
            across[i] += (b[k] - a[k]) * a[AXES + 3 * i + k]
        for j in range(3):
            cosines[i, j] = 0.0
            for k in range(3):
                cosines[i, j] += a[AXES + 3 * i + k] * b[AXES + 3 * j + k]
    half_a, half_b = a[HALF:BOX], b[HALF:BOX]
    for i in range(3):  # the three face normals of each box
        reach_b = 0.0
        reach_a, distance = 0.0, 0.0
        for j in range(3):
            reach_b += half_b[j] * abs(cosines[i, j])
            reach_a += half_a[j] * abs(cosines[j, i])
            distance += across[j] * cosines[j, i]
        if abs(across[i]) > half_a[i] + reach_b + margin:
            return False
        if abs(distance) > half_b[i] + reach_a + margin:
            return False
    for i in range(3):  # the nine cross products of an edge of each box
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            length = math.sqrt(max(1.0 - cosines[i, j] ** 2, 0.0))
            if length < 1e-6:  # parallel edges: covered by the face normals
                continue
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            reach = half_a[i1] * abs(cosines[i2, j]) + half_a[i2] * abs(cosines[i1, j])
            reach += half_b[j1] * abs(cosines[i, j2]) + half_b[j2] * abs(cosines[i, j1])
            distance = across[i2] * cosines[i1, j] - across[i1] * cosines[i2, j]
            if abs(distance) > reach + margin * length:
                return False
    return True
