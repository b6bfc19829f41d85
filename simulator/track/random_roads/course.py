"""The course of a random road in the plane: a polygon whose corners are rounded to bends.

A polygon is closed, so the road closes without a search. Lengths are in metres, angles in degrees,
left positive. Both are rounded to the number of decimals that the TOML file contains.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from simulator.arrays import FloatArray
from simulator.track.layout import Bend, Segment, Straight, close, cut, place, segment_length
from simulator.track.random_roads.kinds import Kind

MIN_STRAIGHT_M: Final = 1.0
MIN_BEND_M: Final = 8.0
"""Least length of a bend; a shorter bend would be a kink."""
MIN_TURN_DEG: Final = 0.5
SHARP_DEG: Final = 35.0
"""Least turn of a corner that may consist of several arcs."""
MIN_BANKED_SPIRAL_M: Final = 8.0
RANK_NOISE: Final = 0.6
"""Largest random change of the logarithm of the radius that fits a corner. The corners are sorted
by the changed radius, and small radii are assigned to the first corners. So small radii are mostly
in corners with little room."""


class DoesNotFit(Exception):
    """Raised if a polygon leaves no room for a bend; the caller tries another random polygon."""


@dataclass(frozen=True)
class Arc:
    """An arc of a bend, with spirals before and after it. It is written as one [[segment]] of the
    TOML file."""

    radius: float
    angle: float
    spiral: float
    banking: float

    def bend(self) -> Bend:
        return Bend(self.radius, math.radians(self.angle), self.spiral, 0.0, 0.0)

    def scaled(self, factor: float) -> "Arc":
        """Return the arc with radius and spirals multiplied by `factor`. The spirals are rounded
        down, so that they are not too long for the arc."""
        return replace(
            self,
            radius=round(self.radius * factor, 2),
            spiral=math.floor(self.spiral * factor * 10.0) / 10.0,
        )


Corner = tuple[Arc, ...]


@dataclass(frozen=True)
class Course:
    """A closed course; the straight `straights[i]` (m) leads to `corners[i]`."""

    straights: tuple[float, ...]
    corners: tuple[Corner, ...]


def draw_course(kind: Kind, unevenness: float, rng: np.random.Generator) -> Course:
    """Return a random closed course of `kind`, which may cross itself. The logarithm of the
    corners' relative distances from the centre is random in [-unevenness, unevenness]. Raises
    DoesNotFit."""
    points = _polygon(kind, unevenness, rng)
    edges = np.roll(points, -1, axis=0) - points  # edge i leads from corner i to corner i + 1
    lengths = np.hypot(edges[:, 0], edges[:, 1])
    turns = _turns(edges)
    if np.abs(turns).min() < MIN_TURN_DEG or np.abs(turns).max() > 165.0:
        raise DoesNotFit
    room = (np.minimum(lengths, np.roll(lengths, 1)) - MIN_STRAIGHT_M) / 2.0
    largest = room / np.tan(np.radians(np.abs(turns)) / 2.0)
    if largest.min() < kind.radius_m[0]:
        raise DoesNotFit
    corners = _fitted(kind, _corners(kind, turns, largest, rng), room)
    t_in, t_out = _tangents(corners)
    before = np.roll(lengths, 1) - t_in - np.roll(t_out, 1)
    return _closed(before, corners)


def _polygon(kind: Kind, unevenness: float, rng: np.random.Generator) -> FloatArray:
    """Return random corners (n, 2) in m round a centre, at uneven angles and distances. The
    logarithm of the distances is random in [-unevenness, unevenness], before the corners are
    scaled."""
    count = int(rng.integers(kind.corners[0], kind.corners[1], endpoint=True))
    gaps = rng.uniform(0.65, 1.35, count)
    around = np.cumsum(gaps) * (2.0 * math.pi / gaps.sum())
    distance = np.exp(rng.uniform(-unevenness, unevenness, count))
    stretch = rng.uniform(0.55, 1.0)
    points = np.stack((distance * np.cos(around), stretch * distance * np.sin(around)), axis=1)
    if rng.uniform() < 0.5:
        points = points[::-1]
    edges = np.roll(points, -1, axis=0) - points
    mean = rng.uniform(*kind.edge_m)
    return np.asarray(points * (mean / np.hypot(edges[:, 0], edges[:, 1]).mean()))


def _turns(edges: FloatArray) -> FloatArray:
    """Return the turn (n,) at the start of each of `edges` (n, 2), in degrees with three decimals.
    The sum of the turns is 360 or -360."""
    before = np.roll(edges, 1, axis=0)
    cross = before[:, 0] * edges[:, 1] - before[:, 1] * edges[:, 0]
    turns = np.degrees(np.arctan2(cross, (before * edges).sum(axis=1)))
    millis = np.rint(turns * 1000.0)
    millis[np.argmax(np.abs(millis))] += math.copysign(360_000.0, millis.sum()) - millis.sum()
    return np.asarray(millis / 1000.0)


def _corners(
    kind: Kind, turns: FloatArray, largest: FloatArray, rng: np.random.Generator
) -> tuple[Corner, ...]:
    """Return a bend for each of `turns` (n,), in degrees. The radii are log-uniform over all bends.
    Small radii are in corners whose `largest` possible radius (n,), m, is small."""
    count = len(turns)
    low, high = np.log(kind.radius_m)
    radii = np.exp(low + (high - low) * (np.arange(count) + rng.uniform(size=count)) / count)
    order = np.argsort(np.log(largest) + rng.uniform(-RANK_NOISE, RANK_NOISE, count))
    radius = np.empty(count)
    radius[order] = radii
    return tuple(
        _corner(kind, turn, min(max(r, _least_radius(turn)), kind.radius_m[1]), rng)
        for turn, r in zip(turns.tolist(), radius.tolist(), strict=True)
    )


def _least_radius(turn: float) -> float:
    """Return the radius (m) at which a bend of `turn` degrees has the length MIN_BEND_M."""
    return MIN_BEND_M / math.radians(abs(turn))


def _corner(kind: Kind, turn: float, radius: float, rng: np.random.Generator) -> Corner:
    """Return one corner that turns by `turn` degrees; its smallest radius is `radius`."""
    abrupt, compound, spiral, banking = rng.uniform(size=4).tolist()
    if compound < kind.compound and abs(turn) > SHARP_DEG:
        return _compound(kind, turn, radius, rng)
    if abrupt < kind.abrupt:
        return (Arc(radius, turn, 0.0, 0.0),)
    share = kind.spiral[0] + (kind.spiral[1] - kind.spiral[0]) * spiral
    length = min(share * radius * math.radians(abs(turn)), 150.0)
    degrees = kind.banking_deg[0] + (kind.banking_deg[1] - kind.banking_deg[0]) * banking
    return (Arc(radius, turn, length, round(degrees, 1)),)


def _compound(kind: Kind, turn: float, radius: float, rng: np.random.Generator) -> Corner:
    """Return a corner of `turn` degrees that consists of two or three arcs without spirals. Its
    smallest radius is `radius` (m)."""
    count = int(rng.integers(2, 4))
    shares = rng.uniform(0.6, 1.4, count)
    angles = [round(float(a), 3) for a in turn * shares / shares.sum()]
    angles[-1] = round(turn - sum(angles[:-1]), 3)
    factors = rng.uniform(1.5, 4.0, count)
    factors[rng.integers(count)] = 1.0
    return tuple(
        Arc(min(radius * factor, kind.radius_m[1]), angle, 0.0, 0.0)
        for factor, angle in zip(factors.tolist(), angles, strict=True)
    )


def _fitted(kind: Kind, corners: tuple[Corner, ...], room: FloatArray) -> tuple[Corner, ...]:
    """Shrink each corner that needs more of an edge than its `room` (n,), m. Raises DoesNotFit if a
    corner then has too small a radius or is too short."""
    need = np.maximum(*_tangents(corners))
    factors = np.minimum(1.0, 0.995 * room / need).tolist()
    fitted = []
    for corner, factor in zip(corners, factors, strict=True):
        arcs = tuple(_without_short_banking(arc.scaled(factor)) for arc in corner)
        bend_m = sum(arc.radius * math.radians(abs(arc.angle)) for arc in arcs)
        if min(arc.radius for arc in arcs) < kind.radius_m[0] or bend_m < 0.9 * MIN_BEND_M:
            raise DoesNotFit
        fitted.append(arcs)
    return tuple(fitted)


def _without_short_banking(arc: Arc) -> Arc:
    """Return the arc without banking and spiral if its spiral is too short to bank the road."""
    return arc if arc.spiral >= MIN_BANKED_SPIRAL_M else replace(arc, spiral=0.0, banking=0.0)


def _tangents(corners: tuple[Corner, ...]) -> tuple[FloatArray, FloatArray]:
    """Return the lengths (n,) that each corner uses of the edge before and of the edge after it."""
    bends: list[Segment] = [arc.bend() for corner in corners for arc in corner]
    placed = place(cut(bends))
    lengths = [sum(segment_length(arc.bend()) for arc in corner) for corner in corners]
    at = np.concatenate(([0.0], np.cumsum(lengths)))[:-1]
    first = np.searchsorted(placed.s0, at + 1e-6, side="right") - 1
    x = np.append(placed.x0[first], placed.end[0])
    y = np.append(placed.y0[first], placed.end[1])
    heading = np.append(placed.heading0[first], placed.end[2])
    dx, dy, turn = np.diff(x), np.diff(y), np.diff(heading)
    cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
    ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
    t_out = left / np.sin(turn)
    return ahead - t_out * np.cos(turn), t_out


def _closed(before: FloatArray, corners: tuple[Corner, ...]) -> Course:
    """Return the course with straights that close the loop; it starts with the longest straight.
    `before` (n,) is the length (m) of the straight before each corner. Raises DoesNotFit if a
    straight is too short."""
    first = int(np.argmax(before))
    order = [*range(first, len(corners)), *range(first)]
    segments: list[Segment] = []
    for i in order:
        segments.append(Straight(float(before[i]), 0.0))
        segments += [arc.bend() for arc in corners[i]]
    closed, _ = close(segments)
    straights = tuple(round(s.length, 3) for s in closed if isinstance(s, Straight))
    if min(straights) < 0.4 * MIN_STRAIGHT_M:
        raise DoesNotFit
    return Course(straights, tuple(corners[i] for i in order))
