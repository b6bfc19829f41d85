"""Range beams in the road plane: distances to the track's edge and to traffic. Metres, radians."""

import math

import numpy as np

from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.track.piece_table import COS0, CURVATURE, LENGTH, SIN0, X0, Y0, Table, locate

RANGE_M = 200.0
OFF_TRACK = -1.0
BEAM_ANGLES: FloatArray = np.radians(np.arange(90.0, -91.0, -10.0))
"""Angles (19,) of the beams from the car's heading, from +90 deg (left) to -90 deg."""

MOST_PIECES = 4096
"""Largest number of pieces that a beam crosses; 200 m of the finest spiral have about 100."""


@compiled
def track_beams(
    table: Table,
    piece: int,
    x: float,
    y: float,
    yaw: float,
    angles: FloatArray,
    edge: float,
    distances: FloatArray,
) -> None:
    """Fill `distances` (n,) with the distances (m) from (x, y) to the track's edge in the
    directions `yaw` + `angles` (n,) (rad); -1 if the point is off the track. `edge` is the edge's
    distance (m) from the centre. The search starts at the piece with the index `piece`, -1 if
    unknown."""
    at, _, d = locate(table, x, y, piece)
    for i in range(angles.shape[0]):
        if abs(d) > edge:
            distances[i] = OFF_TRACK
        else:
            distances[i] = edge_distance(table, at, x, y, yaw + angles[i], edge)


@compiled
def edge_distance(
    table: Table, piece: int, x: float, y: float, direction: float, edge: float
) -> float:
    """Return the distance (m) from a point (x, y) on the road to the point where a ray in the world
    `direction` (rad) leaves the road, at most 200 m. `edge` (m): the edges' distance from the
    centre.

    The function follows the ray from piece to piece. In each piece, both edges are lines or
    circles, and the intersection is the root of a quadratic equation.
    """
    cos_d, sin_d = math.cos(direction), math.sin(direction)
    passed, last_move = 0.0, 0
    for _ in range(MOST_PIECES):
        cos_h, sin_h = table[piece, COS0], table[piece, SIN0]
        k = table[piece, CURVATURE]
        # The ray is (u, v) + t (cu, cv) in the frame of the piece's start.
        dx, dy = x - table[piece, X0], y - table[piece, Y0]
        u, v = dx * cos_h + dy * sin_h, dy * cos_h - dx * sin_h
        cu, cv = cos_d * cos_h + sin_d * sin_h, sin_d * cos_h - cos_d * sin_h
        exit_t = leaves_edges(k, u, v, cu, cv, edge, passed)
        # A straight line rotates in one direction about the bend's centre. So it crosses the piece
        # either forwards or backwards, and can leave it only at one end.
        ahead = cu * (1.0 - k * v) + cv * k * u > 0.0
        move = 1 if ahead else -1
        # If the direction changes, the ray lies in a kink between two pieces.
        if move == -last_move:
            return min(exit_t, RANGE_M)
        end_t = crosses_end(table[piece, LENGTH] if ahead else 0.0, k, u, v, cu, cv, move)
        if exit_t <= end_t or end_t >= RANGE_M:
            return min(exit_t, RANGE_M)
        passed, last_move = max(passed, end_t), move
        piece = (piece + move) % table.shape[0]
    return RANGE_M


@compiled
def leaves_edges(
    k: float, u: float, v: float, cu: float, cv: float, edge: float, passed: float
) -> float:
    """Return the distance (m) along a ray, from `passed` on, at which the ray leaves a road of
    constant curvature `k` (1/m) without ends. The ray starts at (u, v) m with the unit direction
    (cu, cv), in the frame of the piece's start (u ahead, v left).

    The offset d of the point (u, v) is the root of k d^2 - 2 d = k (u^2 + v^2) - 2 v. So the ray's
    distance from an edge has the sign of a t^2 + 2 b t + c, without cancellation as k approaches 0.
    """
    b = k * (u * cu + v * cv) - cv
    here = k * (u * u + v * v) - 2.0 * v
    nearest = math.inf
    for side in (1.0, -1.0):
        # The polynomial is positive on the road; an edge beyond the bend's centre does not exist.
        if k * side * edge >= 1.0:
            continue
        a, half_b, c = side * k, side * b, side * here + 2.0 * edge - side * k * edge * edge
        if c + passed * (2.0 * half_b + passed * a) <= 0.0:
            return passed
        nearest = min(nearest, falling_root(a, half_b, c, passed))
    return nearest


@compiled
def falling_root(a: float, half_b: float, c: float, passed: float) -> float:
    """Return the smallest root t >= `passed` of a t^2 + 2 half_b t + c, which is positive at t =
    `passed`; infinity if there is no root."""
    square = half_b * half_b - a * c
    if square < 0.0:
        return math.inf
    root = math.sqrt(square)
    # Of the two forms of the root, this one adds numbers of the same sign, without cancellation.
    top, bottom = (half_b + root, -a) if half_b > 0.0 else (c, root - half_b)
    if bottom == 0.0:
        return math.inf
    t = top / bottom
    return t if t >= passed else math.inf


@compiled
def crosses_end(
    along: float, k: float, u: float, v: float, cu: float, cv: float, move: int
) -> float:
    """Return the distance (m) along a ray at which it crosses the normal of the centre line `along`
    m from the start of a piece of curvature `k` (1/m). The ray starts at (u, v) m with the unit
    direction (cu, cv), as in `leaves_edges`. Returns infinity unless the ray crosses the normal
    forwards (`move` = 1) or backwards (`move` = -1)."""
    half_turn = 0.5 * along * k
    sin_half, cos_half = math.sin(half_turn), math.cos(half_turn)
    chord = along if half_turn == 0.0 else along * sin_half / half_turn
    tangent_u, tangent_v = 1.0 - 2.0 * sin_half * sin_half, 2.0 * sin_half * cos_half
    rate = cu * tangent_u + cv * tangent_v
    if rate * move <= 0.0:
        return math.inf
    return ((chord * cos_half - u) * tangent_u + (chord * sin_half - v) * tangent_v) / rate


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
    """Shorten `distances` (n,) (m) of beams to the points where they meet boxes of `length` x
    `width` m. The beams start at (x, y) in the directions `yaw` + `angles` (n,) (rad). `poses` (k,
    6) of the boxes are x, y, z, roll, pitch, yaw."""
    for i in range(angles.shape[0]):
        for k in range(poses.shape[0]):
            turn = poses[k, 5]
            dx, dy = x - poses[k, 0], y - poses[k, 1]
            # The ray in the box's own frame is cut by the two pairs of sides (slab method).
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
    """Return the least and the greatest t for which start + t rate lies in [-half, half], or (inf,
    -inf) if no t does."""
    if abs(rate) < 1e-12:
        return (-math.inf, math.inf) if abs(start) <= half else (math.inf, -math.inf)
    first, second = (-half - start) / rate, (half - start) / rate
    return min(first, second), max(first, second)
