"""Range beams in the road plane: how far to the track's edge, and to traffic. Metres, radians."""

import math

import numpy as np
from numpy.typing import NDArray

from simulator.compiled import compiled
from simulator.track.kernel import Table, locate

FloatArray = NDArray[np.float64]

RANGE_M = 200.0
OFF_TRACK = -1.0
BEAM_ANGLES: FloatArray = np.radians(np.arange(90.0, -91.0, -10.0))
"""(19,) from the left (+90 deg) to the right of the car's heading."""

LEAST_STEP_M = 0.5
"""Marching never goes slower: a bulge of the road crossed in less than this is not seen."""
ROOT_STEPS = 60
ROOT_TOLERANCE_M = 1e-9


@compiled
def beyond_edge(table: Table, piece: int, x: float, y: float, edge: float) -> tuple[float, int]:
    """(metres outside the edge, negative on the road; piece index there)."""
    at, _, d = locate(table, x, y, piece)
    return abs(d) - edge, at


@compiled
def edge_distance(
    table: Table, piece: int, x: float, y: float, direction: float, edge: float
) -> float:
    """Distance (m) from a point on the road to where the ray leaves it; at most RANGE_M.

    The road's edge is nowhere nearer than `edge - |to_middle|`, so the ray marches by that much;
    the crossing itself is found with the Illinois method.
    """
    cos_d, sin_d = math.cos(direction), math.sin(direction)
    inside, at = beyond_edge(table, piece, x, y, edge)
    near = 0.0
    while near < RANGE_M:
        far = min(near + max(-inside, LEAST_STEP_M), RANGE_M)
        outside, ahead = beyond_edge(table, at, x + far * cos_d, y + far * sin_d, edge)
        if outside > 0.0:
            return crossing(table, at, x, y, direction, edge, near, inside, far, outside)
        near, inside, at = far, outside, ahead
    return RANGE_M


@compiled
def crossing(
    table: Table,
    piece: int,
    x: float,
    y: float,
    direction: float,
    edge: float,
    near: float,
    inside: float,
    far: float,
    outside: float,
) -> float:
    """Root of the edge function between `near` (inside <= 0) and `far` (outside > 0)."""
    cos_d, sin_d = math.cos(direction), math.sin(direction)
    for _ in range(ROOT_STEPS):
        guess = (near * outside - far * inside) / (outside - inside)
        value, _ = beyond_edge(table, piece, x + guess * cos_d, y + guess * sin_d, edge)
        if abs(value) < ROOT_TOLERANCE_M:
            return guess
        if value > 0.0:
            far, outside = guess, value
            inside *= 0.5
        else:
            near, inside = guess, value
            outside *= 0.5
    return 0.5 * (near + far)


@compiled
def track_beams(
    table: Table, piece: int, x: float, y: float, yaw: float, angles: FloatArray, edge: float
) -> FloatArray:
    """Distances (n,) to the track's edge along `angles` from the car's heading; -1 off it."""
    distances = np.full(angles.shape[0], OFF_TRACK)
    here, at = beyond_edge(table, piece, x, y, edge)
    if here > 0.0:
        return distances
    for i in range(angles.shape[0]):
        distances[i] = edge_distance(table, at, x, y, yaw + angles[i], edge)
    return distances


@compiled
def shorten_at_boxes(
    distances: FloatArray,
    x: float,
    y: float,
    yaw: float,
    angles: FloatArray,
    poses: FloatArray,
    length: float,
    width: float,
) -> None:
    """Cut `distances` (n,) short where the beam meets a box: poses (k, 6), x, y first, yaw last."""
    for i in range(angles.shape[0]):
        for k in range(poses.shape[0]):
            turn = poses[k, 5]
            dx, dy = x - poses[k, 0], y - poses[k, 1]
            # The ray in the box's own frame, cut by its two pairs of sides (slab method).
            u = dx * math.cos(turn) + dy * math.sin(turn)
            v = -dx * math.sin(turn) + dy * math.cos(turn)
            heading = yaw + angles[i] - turn
            enter, leave = cut(u, math.cos(heading), 0.5 * length)
            enter_v, leave_v = cut(v, math.sin(heading), 0.5 * width)
            enter, leave = max(enter, enter_v, 0.0), min(leave, leave_v)
            if enter <= leave and enter < distances[i]:
                distances[i] = enter


@compiled
def cut(start: float, rate: float, half: float) -> tuple[float, float]:
    """Where start + t rate enters and leaves [-half, half]; an empty interval if it never does."""
    if abs(rate) < 1e-12:
        return (-math.inf, math.inf) if abs(start) <= half else (math.inf, -math.inf)
    first, second = (-half - start) / rate, (half - start) / rate
    return min(first, second), max(first, second)
