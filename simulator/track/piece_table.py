"""Compiled functions on the table (P, 16) of a track, with one row per piece of constant curvature.

A piece is a straight or an arc of the centre line; its edge heights are linear in the arc length.
World frame (x, y plane, z up); s along the centre line, to_middle left positive; metres, radians.
"""

import math

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled, inlined

Table = NDArray[np.float64]

S0, LENGTH, X0, Y0, HEADING0, CURVATURE = 0, 1, 2, 3, 4, 5
Z_LEFT0, Z_RIGHT0, Z_LEFT1, Z_RIGHT1 = 6, 7, 8, 9
HALF_WIDTH, TRACK_LENGTH = 10, 11
GEOMETRY = 12
"""Number of columns that define the track. The columns after these columns are computed from them
once."""
COS0, SIN0, LEFT_SLOPE, RIGHT_SLOPE = 12, 13, 14, 15
COLUMNS = 16

MAX_WALK = 64
"""Largest number of pieces that a search walks from the hint before all pieces are searched."""
HINT_REACH_M = 40.0
"""Largest distance (m) of a point from the centre line for which a search near the hint is trusted.
A point farther away may belong to another part of the track."""


@inlined
def foot(table: Table, index: int, x: float, y: float) -> tuple[float, float]:
    """Return the foot point of (x, y) on piece `index`, extended beyond both ends, as (distance
    along the piece from its start, to_middle) in m.

    The formula is exact on arcs, without cancellation as the curvature approaches 0. A piece turns
    by at most a quarter circle (see `pieces.assemble`), so for points near the piece the angle does
    not wrap.
    """
    dx = x - table[index, X0]
    dy = y - table[index, Y0]
    cos_h, sin_h = table[index, COS0], table[index, SIN0]
    u = dx * cos_h + dy * sin_h
    v = -dx * sin_h + dy * cos_h
    k = table[index, CURVATURE]
    if k == 0.0:
        return u, v
    q = math.sqrt((k * u) ** 2 + (1.0 - k * v) ** 2)
    return math.atan2(k * u, 1.0 - k * v) / k, (2.0 * v - k * (u * u + v * v)) / (1.0 + q)


@compiled
def centre_point(table: Table, index: int, along: float) -> tuple[float, float]:
    """Return the point (x, y) of the centre line `along` metres from the start of piece `index`."""
    half_turn = 0.5 * along * table[index, CURVATURE]
    chord = along
    if half_turn != 0.0:
        chord = along * math.sin(half_turn) / half_turn
    direction = table[index, HEADING0] + half_turn
    return (
        table[index, X0] + chord * math.cos(direction),
        table[index, Y0] + chord * math.sin(direction),
    )


@compiled
def complete_table(table: Table) -> None:
    """Fill the columns COS0 and SIN0 (of the heading), LEFT_SLOPE and RIGHT_SLOPE (dz/ds of the
    edges), which are computed from the other columns."""
    for index in range(table.shape[0]):
        row = table[index]
        row[COS0], row[SIN0] = math.cos(row[HEADING0]), math.sin(row[HEADING0])
        row[LEFT_SLOPE] = (row[Z_LEFT1] - row[Z_LEFT0]) / row[LENGTH]
        row[RIGHT_SLOPE] = (row[Z_RIGHT1] - row[Z_RIGHT0]) / row[LENGTH]


@compiled
def index_at(table: Table, s: float) -> int:
    """Return the index of the piece that contains `s`; s wraps round the lap."""
    wrapped = wrap(table, s)
    index = int(np.searchsorted(table[:, S0], wrapped, side="right")) - 1
    return max(index, 0)


@compiled
def index_near(table: Table, s: float, hint: int) -> int:
    """Return the index of the piece that contains `s`; s wraps round the lap. The whole table is
    searched only if s is neither on piece `hint` nor on one of the 63 pieces after it."""
    wrapped, count = wrap(table, s), table.shape[0]
    for index in range(hint, min(hint + MAX_WALK, count)):
        if wrapped < table[index, S0]:
            break
        if index + 1 == count or wrapped < table[index + 1, S0]:
            return index
    return index_at(table, s)


@inlined
def wrap(table: Table, s: float) -> float:
    """Wrap `s` into [0, track length)."""
    total = table[0, TRACK_LENGTH]
    wrapped = s - total * math.floor(s / total)
    return wrapped if wrapped < total else 0.0


@compiled
def locate_everywhere(table: Table, x: float, y: float) -> tuple[int, float, float]:
    """Return the track coordinates (piece index, s, to_middle) of the world point (x, y), from the
    nearest point of the whole centre line. Of several equally near points the first is used."""
    best, best_s, best_d, best_squared = 0, 0.0, 0.0, math.inf
    for index in range(table.shape[0]):
        reach = table[index, LENGTH]
        dx = x - table[index, X0]
        dy = y - table[index, Y0]
        # No point of a piece is farther from the piece's start than the piece's length.
        if best_squared < math.inf:
            start_distance = math.sqrt(dx * dx + dy * dy)
            if start_distance > reach + math.sqrt(best_squared):
                continue
        along, d = foot(table, index, x, y)
        along = min(max(along, 0.0), reach)
        px, py = centre_point(table, index, along)
        squared = (x - px) ** 2 + (y - py) ** 2
        if squared < best_squared:
            best, best_s, best_d, best_squared = index, along, d, squared
    # In the wedge outside a kink of the centre line (the closing joint of a TORCS track) no
    # perpendicular foot exists; there the offset from the extended piece is an approximation.
    return at_foot(table, best, best_s, best_d)


@inlined
def at_foot(table: Table, index: int, along: float, to_middle: float) -> tuple[int, float, float]:
    """Return the track coordinates (piece index, s, to_middle) of a point whose foot lies `along` m
    from the start of piece `index`. The end of the last piece is the start of the first one."""
    s = table[index, S0] + along
    if s >= table[0, TRACK_LENGTH]:
        return 0, 0.0, to_middle
    return index, s, to_middle


@inlined
def locate(table: Table, x: float, y: float, hint_index: int) -> tuple[int, float, float]:
    """Return the track coordinates of a world point: (piece index, s, to_middle).

    With `hint_index` >= 0 the search walks from that piece to its neighbours, so that a car under a
    bridge stays on its own road. With -1, a hint too far off, or a point beyond the centre of a
    bend, the whole track is searched. s is in [0, track length).
    """
    count = table.shape[0]
    if hint_index < 0 or hint_index >= count:
        return locate_everywhere(table, x, y)
    index, last_move = hint_index, 0
    for _ in range(min(MAX_WALK, count)):
        along, d = foot(table, index, x, y)
        length = table[index, LENGTH]
        move = 0
        if along < 0.0:
            move = -1
        elif along > length:
            move = 1
        # If the search turns back, the point's foot is the joint between two pieces.
        if move == 0 or move == -last_move:
            along = min(max(along, 0.0), length)
            if abs(d) > HINT_REACH_M or d * table[index, CURVATURE] >= 1.0:
                return locate_everywhere(table, x, y)
            return at_foot(table, index, along, d)
        last_move = move
        index = (index + move) % count
    return locate_everywhere(table, x, y)


@inlined
def surface(
    table: Table, index: int, s: float, to_middle: float
) -> tuple[float, float, float, float]:
    """Return height and unit normal (z, nx, ny, nz) of the road plane at (s, to_middle) on piece
    `index`.

    Beyond the track's width the banked plane continues.
    """
    length = table[index, LENGTH]
    along = min(max(s - table[index, S0], 0.0), length)
    left_slope, right_slope = table[index, LEFT_SLOPE], table[index, RIGHT_SLOPE]
    left = table[index, Z_LEFT0] + left_slope * along
    right = table[index, Z_RIGHT0] + right_slope * along
    width = 2.0 * table[index, HALF_WIDTH]
    across = (left - right) / width
    share = to_middle / width
    k = table[index, CURVATURE]
    # At offset y, 1 m of s is (1 - k y) m on the ground.
    stretch = max(1.0 - k * to_middle, 0.05)
    slope = (0.5 * (left_slope + right_slope) + share * (left_slope - right_slope)) / stretch
    heading = table[index, HEADING0] + k * along
    if heading == table[index, HEADING0]:  # on a straight
        cos_h, sin_h = table[index, COS0], table[index, SIN0]
    else:
        cos_h, sin_h = math.cos(heading), math.sin(heading)
    gx = slope * cos_h - across * sin_h
    gy = slope * sin_h + across * cos_h
    norm = math.sqrt(1.0 + gx * gx + gy * gy)
    z = 0.5 * (left + right) + across * to_middle
    return z, -gx / norm, -gy / norm, 1.0 / norm


@compiled
def foot_offset(table: Table, index: int, s: float, to_middle: float, z: float) -> float:
    """Return the lateral offset (m) of the foot of a point at (s, to_middle, z) on the road plane
    of piece `index`.

    The foot is the nearest point of the road plane. On a banked road it does not lie vertically
    below the point, but further up the bank.
    """
    z_road, nx, ny, nz = surface(table, index, s, to_middle)
    height = (z - z_road) * nz
    along = min(max(s - table[index, S0], 0.0), table[index, LENGTH])
    heading = table[index, HEADING0] + table[index, CURVATURE] * along
    return to_middle - height * (ny * math.cos(heading) - nx * math.sin(heading))


@compiled
def pose_at(table: Table, s: float) -> tuple[float, float, float, float, float]:
    """Return the centre line's pose (x, y, z, heading, curvature) at `s`, which wraps round the
    lap. The heading (rad) is not wrapped into (-pi, pi]."""
    index = index_at(table, s)
    wrapped = wrap(table, s)
    along = wrapped - table[index, S0]
    x, y = centre_point(table, index, along)
    z, _, _, _ = surface(table, index, wrapped, 0.0)
    k = table[index, CURVATURE]
    return x, y, z, table[index, HEADING0] + k * along, k


@compiled
def road_points(
    table: Table, distances: NDArray[np.float64], offsets: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return points (offsets, distances, 3) of the road plane at all pairs of `offsets` (m) and
    `distances` along s (m), which wrap round the lap."""
    points = np.empty((offsets.shape[0], distances.shape[0], 3))
    for i in range(distances.shape[0]):
        index = index_at(table, distances[i])
        along = wrap(table, distances[i]) - table[index, S0]
        x, y = centre_point(table, index, along)
        heading = table[index, HEADING0] + table[index, CURVATURE] * along
        sin_h, cos_h = math.sin(heading), math.cos(heading)
        share = along / table[index, LENGTH]
        left = table[index, Z_LEFT0] + (table[index, Z_LEFT1] - table[index, Z_LEFT0]) * share
        right = table[index, Z_RIGHT0] + (table[index, Z_RIGHT1] - table[index, Z_RIGHT0]) * share
        across = (left - right) / (2.0 * table[index, HALF_WIDTH])
        for k in range(offsets.shape[0]):
            points[k, i, 0] = x - offsets[k] * sin_h
            points[k, i, 1] = y + offsets[k] * cos_h
            points[k, i, 2] = 0.5 * (left + right) + across * offsets[k]
    return points
