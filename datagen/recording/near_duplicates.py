"""Frames that show nearly the same thing: same road, place, offset, yaw and light, two rounds.

A split with many of them across its sides measures memory. Found with a grid of cells as large as
the tolerances, sorted: near frames lie in the same cell or the next.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.recording.labels import Labels
from datagen.recording.round_metadata import RoundInfo

PAIRS_AT_ONCE = 4_000_000
WORST = 10


@dataclass(frozen=True, slots=True)
class Tolerances:
    """How far apart two frames may be and still be near: along the road, across it, in yaw."""

    s_m: float = 0.5
    to_middle_m: float = 0.1
    angle_deg: float = 0.5


@dataclass(frozen=True, slots=True)
class Pair:
    """A frame and its nearest on the other side; `distance` 0 is the same place, 1 just near."""

    distance: float
    round: str
    frame: int
    other_round: str
    other_frame: int
    track: str
    s_m: float


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Of `frames`, `near` have a near frame on the other side; the nearest pairs first."""

    frames: int
    near: int
    worst: tuple[Pair, ...]

    def as_json(self) -> dict[str, Any]:
        return {**asdict(self), "share": round(self.near / max(self.frames, 1), 4)}


def find_neighbours(
    labels: Labels,
    rounds: Sequence[RoundInfo],
    side: NDArray[np.bool_],
    other: NDArray[np.bool_],
    tolerances: Tolerances,
) -> Neighbours:
    """Which frames where `side` (N,) is set are near one where `other` (N,) is.

    Where a lap ends is not bridged: a frame just before the line and one just behind it are far.
    """
    near, partner = np.flatnonzero(side), np.flatnonzero(other)
    if not (near.size and partner.size):
        return Neighbours(int(near.size), 0, ())
    places = _places(labels, tolerances)
    cells, strides = _cells(places, _scenes(labels, rounds))
    partner = partner[np.argsort(cells[partner], kind="stable")]
    best = np.full(near.size, np.inf)
    nearest = np.zeros(near.size, np.int64)
    for rows, candidates in _candidates(cells[near], cells[partner], strides):
        apart = np.abs(places[near[rows]] - places[partner[candidates]]).max(axis=1)
        order = np.argsort(-apart)  # of several for one frame, the last written is the nearest
        order = order[apart[order] < best[rows[order]]]
        best[rows[order]] = apart[order]
        nearest[rows[order]] = partner[candidates[order]]
    close = best <= 1.0
    worst = np.argsort(best, kind="stable")[: min(WORST, int(close.sum()))]
    starts = np.searchsorted(labels.round, np.arange(len(rounds)))
    pairs = [_pair(labels, rounds, starts, int(near[i]), int(nearest[i]), best[i]) for i in worst]
    return Neighbours(int(near.size), int(close.sum()), tuple(pairs))


def _places(labels: Labels, tolerances: Tolerances) -> NDArray[np.float64]:
    """(N, 3): place, offset and yaw in units of their tolerance."""
    columns = (
        labels.s / tolerances.s_m,
        labels.to_middle / tolerances.to_middle_m,
        np.degrees(labels.angle) / tolerances.angle_deg,
    )
    return np.stack(columns, axis=1).astype(np.float64)


def _scenes(labels: Labels, rounds: Sequence[RoundInfo]) -> NDArray[np.int64]:
    """(N,) a number for the road and light of each frame."""
    numbers: dict[tuple[str, int], int] = {}
    of_round = [numbers.setdefault((r.track, r.lanes), len(numbers)) for r in rounds]
    kinds, light = np.unique(labels.light, return_inverse=True)
    return np.array(of_round, np.int64)[labels.round] * len(kinds) + light


def _cells(
    places: NDArray[np.float64], scenes: NDArray[np.int64]
) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """(N,) one number a cell, neighbours in yaw beside each other; the steps in s and offset."""
    grid = np.floor(places).astype(np.int64)
    grid -= grid.min(axis=0) - 1  # with an empty cell on either side, steps never wrap
    _, offsets, yaws = (int(size) + 2 for size in grid.max(axis=0))
    longest = int(grid[:, 0].max()) + 2
    s_step, offset_step = offsets * yaws, yaws
    cells = scenes * longest * s_step + grid[:, 0] * s_step + grid[:, 1] * offset_step + grid[:, 2]
    return cells, (s_step, offset_step)


def _candidates(
    cells: NDArray[np.int64], partners: NDArray[np.int64], strides: tuple[int, int]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Pairs (row, place in the sorted `partners`) in the same cell or the next, some at a time."""
    for s, offset in product((-1, 0, 1), repeat=2):
        middle = cells + s * strides[0] + offset * strides[1]
        low = np.searchsorted(partners, middle - 1, "left")
        counts = np.searchsorted(partners, middle + 1, "right") - low
        total = np.concatenate([[0], np.cumsum(counts)])
        first = 0
        while first < len(cells):
            last = int(np.searchsorted(total, total[first] + PAIRS_AT_ONCE, "right")) - 1
            last = max(last, first + 1)
            part = slice(first, last)
            rows = np.repeat(np.arange(first, last), counts[part])
            start = np.repeat(low[part] - (total[part] - total[first]), counts[part])
            yield rows, start + np.arange(len(rows))
            first = last


def _pair(
    labels: Labels,
    rounds: Sequence[RoundInfo],
    starts: NDArray[np.int64],
    one: int,
    other: int,
    distance: float,
) -> Pair:
    number, other_number = int(labels.round[one]), int(labels.round[other])
    return Pair(
        distance=round(float(distance), 4),
        round=rounds[number].id,
        frame=one - int(starts[number]),
        other_round=rounds[other_number].id,
        other_frame=other - int(starts[other_number]),
        track=rounds[number].track,
        s_m=round(float(labels.s[one]), 2),
    )
