"""Places pieces of constant curvature end to end, from their lengths, curvatures and edge heights.

Lengths in metres, curvature in 1/m (left positive), headings in radians counter-clockwise.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from simulator.arrays import FloatArray
from simulator.track.errors import TrackError

MAX_TURN: Final = math.pi / 2
"""Largest turn (rad) of a piece. Up to this turn, points near an arc have one foot point on it."""
MAX_GAP_M: Final = 0.28
"""Largest gap between the last piece and the first. Of the 38 tracks of TORCS 1.3.7 all but two
close within 0.09 m; forza has a gap of 0.152 m, wheel-2 of 0.262 m. TORCS accepts both."""
MAX_HEADING_GAP: Final = math.radians(0.5)
ADVICE: Final = "a track must be one closed loop, so correct its last segments"


@dataclass(frozen=True)
class Piece:
    """One piece of a centre line, with the heights of both edges at its start (0) and end (1)."""

    length: float
    curvature: float
    z_left0: float = 0.0
    z_right0: float = 0.0
    z_left1: float = 0.0
    z_right1: float = 0.0


@dataclass(frozen=True)
class Placed:
    """Pieces placed end to end in the plane. The arrays (P,) have one entry per piece; `end` is the
    pose at the end of the last piece."""

    s0: FloatArray
    length: FloatArray
    x0: FloatArray
    y0: FloatArray
    heading0: FloatArray
    curvature: FloatArray
    z_left0: FloatArray
    z_right0: FloatArray
    z_left1: FloatArray
    z_right1: FloatArray
    end: tuple[float, float, float]
    """x, y (m) and unwrapped heading (rad) at the end of the last piece."""


def split_turns(pieces: list[Piece]) -> list[Piece]:
    """Cut every piece that turns by more than a quarter circle into equal parts. The edge heights
    of the parts are interpolated linearly."""
    cut: list[Piece] = []
    for piece in pieces:
        parts = max(1, math.ceil(abs(piece.curvature) * piece.length / MAX_TURN - 1e-9))
        if parts == 1:
            cut.append(piece)
            continue
        for i in range(parts):
            a, b = i / parts, (i + 1) / parts
            cut.append(
                Piece(
                    piece.length / parts,
                    piece.curvature,
                    _between(piece.z_left0, piece.z_left1, a),
                    _between(piece.z_right0, piece.z_right1, a),
                    _between(piece.z_left0, piece.z_left1, b),
                    _between(piece.z_right0, piece.z_right1, b),
                )
            )
    return cut


def _between(start: float, end: float, share: float) -> float:
    return end if share == 1.0 else start + (end - start) * share


def assemble(pieces: list[Piece], x: float = 0.0, y: float = 0.0, heading: float = 0.0) -> Placed:
    """Place pieces end to end, with continuous tangents, from the pose (x, y, heading)."""
    cut = split_turns(pieces)
    length = np.array([piece.length for piece in cut], dtype=np.float64)
    curvature = np.array([piece.curvature for piece in cut], dtype=np.float64)
    heights = np.array([[p.z_left0, p.z_right0, p.z_left1, p.z_right1] for p in cut])
    return put(length, curvature, heights, x, y, heading)


def put(
    length: FloatArray,
    curvature: FloatArray,
    heights: FloatArray,
    x: float = 0.0,
    y: float = 0.0,
    heading: float = 0.0,
) -> Placed:
    """Place pieces with `length` (P,) and `curvature` (P,) end to end from the pose (x, y,
    heading). Each piece turns by at most a quarter circle. The columns of `heights` (P, 4) are the
    heights of the left and right edge at the piece's start, then at its end."""
    turn = curvature * length
    headings = heading + np.concatenate(([0.0], np.cumsum(turn)))
    # np.sinc(t) = sin(pi t)/(pi t) gives the chord of an arc that turns by `turn`.
    chord = length * np.sinc(turn / (2.0 * np.pi))
    middle = headings[:-1] + turn / 2.0
    xs = x + np.concatenate(([0.0], np.cumsum(chord * np.cos(middle))))
    ys = y + np.concatenate(([0.0], np.cumsum(chord * np.sin(middle))))
    return Placed(
        s0=np.concatenate(([0.0], np.cumsum(length)[:-1])),
        length=length,
        x0=xs[:-1],
        y0=ys[:-1],
        heading0=headings[:-1],
        curvature=curvature,
        z_left0=heights[:, 0].copy(),
        z_right0=heights[:, 1].copy(),
        z_left1=heights[:, 2].copy(),
        z_right1=heights[:, 3].copy(),
        end=(float(xs[-1]), float(ys[-1]), float(headings[-1])),
    )


def check_closes(placed: Placed, what: str, max_gap_m: float = MAX_GAP_M) -> None:
    """Raises TrackError unless the pieces `placed` form a closed loop: the end of the last piece
    must be within `max_gap_m` (horizontally and in height) and 0.5 deg of the start of the first.
    `what` names the track in the message."""
    x, y, heading = placed.end
    gap = math.hypot(x - placed.x0[0], y - placed.y0[0])
    height = max(
        abs(placed.z_left1[-1] - placed.z_left0[0]), abs(placed.z_right1[-1] - placed.z_right0[0])
    )
    # The comparisons are negated, so that NaN raises as well.
    if not gap <= max_gap_m:
        raise TrackError(f"{what}: the segments end {gap:.2f} m from their start; {ADVICE}")
    check_turn(heading - float(placed.heading0[0]), what)
    if not height <= max_gap_m:
        raise TrackError(
            f"{what}: the segments end {height:.2f} m above or below their start; {ADVICE}"
        )


def check_turn(turn: float, what: str) -> None:
    """Raises TrackError unless `turn` (rad), by which all segments together turn, is within 0.5 deg
    of a multiple of 360 deg. `what` names the track in the message."""
    if not abs(math.remainder(turn, 2.0 * math.pi)) <= MAX_HEADING_GAP:
        degrees = math.degrees(turn)
        raise TrackError(f"{what}: the segments turn by {degrees:.2f} deg in all; {ADVICE}")
