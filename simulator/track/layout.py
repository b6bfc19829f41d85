"""Converts straights and bends to the pieces of a closed loop, with spirals, banking and heights.

Metres and radians; the angle of a bend is left positive; grades are dz/ds.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.track.errors import TrackError
from simulator.track.pieces import Piece, Placed, put

MAX_STEP_M: Final = 5.0
SPIRAL_STEP_M: Final = 2.0


@dataclass(frozen=True)
class Straight:
    length: float
    grade: float


@dataclass(frozen=True)
class Bend:
    """A bend: a clothoid of length `spiral` (m), an arc of `radius` (m), and the same clothoid back
    to straight."""

    radius: float
    angle: float
    """Turn (rad, left positive) of the whole bend, including its spirals."""
    spiral: float
    banking: float
    """Lateral slope angle (rad), positive if the outer edge is higher. It grows along the spiral
    like the curvature."""
    grade: float


Segment = Straight | Bend
Row = tuple[float, float, float, int]
"""One step: length (m), curvature (1/m), banking at the end (rad, positive if the left edge is
higher), and index of the segment to which the step belongs."""


@dataclass(frozen=True)
class Steps:
    """Short parts ("steps") of constant curvature, cut from segments. Arrays (n,): length in m,
    curvature in 1/m, banking at the end in rad (positive if the left edge is higher)."""

    length: FloatArray
    curvature: FloatArray
    banking_end: FloatArray
    segment: NDArray[np.int64]
    """Index of the segment from which each step was cut."""


def cut(segments: list[Segment]) -> Steps:
    """Cut segments into steps of at most 5 m, and spirals into steps of at most 2 m."""
    rows: list[Row] = []
    for number, segment in enumerate(segments):
        if isinstance(segment, Straight):
            rows += _even(segment.length, 0.0, 0.0, number)
            continue
        sign = math.copysign(1.0, segment.angle)
        k = sign / segment.radius
        arc = abs(segment.angle) * segment.radius - segment.spiral
        ramp = _spiral(segment, sign, number)
        rows += ramp
        if arc > 0.0:
            rows += _even(arc, k, -sign * segment.banking, number)
        # The exit spiral is the entry spiral in reverse order. So the banking at the end of a step
        # of the exit spiral is the banking at the start of the same step of the entry spiral.
        starts = [0.0] + [banking for _, _, banking, _ in ramp[:-1]]
        rows += [
            (length, curvature, start, number)
            for (length, curvature, _, _), start in zip(ramp[::-1], starts[::-1], strict=bool(ramp))
        ]
    length, curvature, banking, number_of = zip(*rows, strict=True)
    return Steps(
        np.array(length), np.array(curvature), np.array(banking), np.array(number_of, dtype=int)
    )


def _even(length: float, k: float, banking: float, number: int) -> list[Row]:
    count = max(1, math.ceil(length / MAX_STEP_M - 1e-9))
    return [(length / count, k, banking, number)] * count


def _spiral(bend: Bend, sign: float, number: int) -> list[Row]:
    """Return the steps of a bend's entry spiral. `sign` is 1 for a left bend, else -1; `number` is
    the index of the bend in the list of segments."""
    count = math.ceil(bend.spiral / SPIRAL_STEP_M - 1e-9)
    # With the curvature at the middle of each step, the sum of the turns is the clothoid's.
    return [
        (
            bend.spiral / count,
            sign / bend.radius * (i + 0.5) / count,
            -sign * bend.banking * (i + 1) / count,
            number,
        )
        for i in range(count)
    ]


def place(steps: Steps) -> Placed:
    """Place the steps end to end in the plane, without heights. A step is at most 5 m long, so it
    never turns by more than a quarter circle and becomes one piece."""
    return put(steps.length, steps.curvature, np.zeros((len(steps.length), 4)))


def close(segments: list[Segment]) -> tuple[list[Segment], float]:
    """Change the lengths of the straights as little as possible, so that the loop closes in the
    plane.

    The end point is linear in the lengths of the straights, so one minimum-norm solution is exact.
    Returns the segments and the largest change (m). Raises TrackError if no change of the straights
    can close the loop.
    """
    placed = place(cut(segments))
    bounds = np.concatenate(([0.0], np.cumsum([segment_length(s) for s in segments])))
    straights = [i for i, s in enumerate(segments) if isinstance(s, Straight)]
    at = np.searchsorted(placed.s0, bounds[straights] + 1e-6, side="right") - 1
    directions = np.stack((np.cos(placed.heading0[at]), np.sin(placed.heading0[at])))
    gram = directions @ directions.T
    determinant = float(gram[0, 0] * gram[1, 1] - gram[0, 1] ** 2)
    if determinant < 1e-6:
        raise TrackError("straights in two directions are needed to close the loop; add one")
    gx, gy = placed.end[0], placed.end[1]
    wx = (gram[1, 1] * gx - gram[0, 1] * gy) / determinant
    wy = (gram[0, 0] * gy - gram[0, 1] * gx) / determinant
    closed = list(segments)
    largest = 0.0
    for i, (cos_h, sin_h) in zip(straights, directions.T, strict=True):
        change = -float(cos_h * wx + sin_h * wy)
        straight = segments[i]
        assert isinstance(straight, Straight)
        closed[i] = replace(straight, length=straight.length + change)
        largest = max(largest, abs(change))
    return closed, largest


def segment_length(segment: Segment) -> float:
    """Return the length (m) of a segment along the centre line. A bend with spirals is longer than
    an arc of the same angle by the length of one spiral."""
    if isinstance(segment, Straight):
        return segment.length
    return abs(segment.angle) * segment.radius + segment.spiral


def heights(segments: list[Segment], s: FloatArray, vertical_curve: float) -> FloatArray:
    """Return the heights (n,) in m of the centre line at `s` (n,) m, from 0 to the length of the
    lap. The height at the start of the lap is 0.

    The mean grade is subtracted, so that the lap ends at the height of its start. The grades are
    averaged over `vertical_curve` metres, which gives parabolic crests and dips as on real roads.
    """
    lengths = np.array([segment_length(segment) for segment in segments])
    grades = np.array([segment.grade for segment in segments])
    total = float(lengths.sum())
    grades = grades - float(np.sum(grades * lengths)) / total
    # Three laps end to end, so that the average near the start includes the end of the lap before.
    grades3, lengths3 = np.tile(grades, 3), np.tile(lengths, 3)
    node = np.concatenate(([0.0], np.cumsum(lengths3))) - total
    z = np.concatenate(([0.0], np.cumsum(grades3 * lengths3)))
    area = np.concatenate(([0.0], np.cumsum((z[:-1] + z[1:]) / 2.0 * lengths3)))

    def integral(t: FloatArray) -> FloatArray:
        i = np.clip(np.searchsorted(node, t, side="right") - 1, 0, len(lengths3) - 1)
        x = t - node[i]
        result: FloatArray = area[i] + z[i] * x + grades3[i] * x * x / 2.0
        return result

    half = vertical_curve / 2.0
    smooth = (integral(s + half) - integral(s - half)) / vertical_curve
    # Without rounding, the last height equals the first.
    if abs(s[-1] - total) < 1e-6:
        smooth[-1] = smooth[0]
    result: FloatArray = smooth - smooth[0]
    return result


def lay(segments: list[Segment], width: float, vertical_curve: float) -> list[Piece]:
    """Return the pieces of a closed list of segments (see `close`), for a track `width` m wide.
    Grades are averaged over `vertical_curve` m."""
    steps = cut(segments)
    s = np.concatenate(([0.0], np.cumsum(steps.length)))
    z = heights(segments, s, vertical_curve)
    lift = np.tan(np.concatenate((steps.banking_end[-1:], steps.banking_end))) * width / 2.0
    left, right = z + lift, z - lift
    columns = (steps.length, steps.curvature, left[:-1], right[:-1], left[1:], right[1:])
    return [Piece(*row) for row in np.column_stack(columns).tolist()]
