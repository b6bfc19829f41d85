"""Near-duplicate frames of two sides of a split: same track and light, nearly the same pose.

A test set with many near-duplicates of training frames measures memorisation. The search uses a
grid whose cells have the size of the tolerances: near frames are in the same or adjacent cells.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.recording.labels import Labels
from datagen.recording.round_metadata import RoundInfo

MAX_PAIRS_AT_ONCE = 4_000_000
MAX_LISTED = 10


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Largest difference of two near-duplicates: along the road, across it, and in yaw."""

    s_m: float = 0.5
    to_middle_m: float = 0.1
    angle_deg: float = 0.5


@dataclass(frozen=True, slots=True)
class NearPair:
    """A frame and the nearest frame of the other side.

    `distance` is the largest difference in units of its tolerance: 0 same pose, 1 the limit.
    """

    distance: float
    round: str
    frame: int
    other_round: str
    other_frame: int
    track: str
    s_m: float


@dataclass(frozen=True, slots=True)
class NearDuplicates:
    """`near` of `frames` frames have a near-duplicate on the other side; `worst`: nearest pairs."""

    frames: int
    near: int
    worst: tuple[NearPair, ...]

    def as_json(self) -> dict[str, Any]:
        return {**asdict(self), "share": round(self.near / max(self.frames, 1), 4)}


def find_near_duplicates(
    labels: Labels,
    rounds: Sequence[RoundInfo],
    side: NDArray[np.bool_],
    other: NDArray[np.bool_],
    tolerances: Tolerances,
) -> NearDuplicates:
    """Near-duplicates of the frames in mask `side` (N,) among the frames in mask `other` (N,).

    The start line is not bridged: a frame just before it and one just after it are far apart.
    """
    near, partner = np.flatnonzero(side), np.flatnonzero(other)
    if not (near.size and partner.size):
        return NearDuplicates(int(near.size), 0, ())
    poses = _scaled_poses(labels, tolerances)
    cells, strides = _grid_cells(poses, _scene_numbers(labels, rounds))
    partner = partner[np.argsort(cells[partner], kind="stable")]
    best = np.full(near.size, np.inf)
    nearest = np.zeros(near.size, np.int64)
    for rows, candidates in _candidate_pairs(cells[near], cells[partner], strides):
        apart = np.abs(poses[near[rows]] - poses[partner[candidates]]).max(axis=1)
        order = np.argsort(-apart)  # numpy keeps the last of several writes to a row: the nearest
        order = order[apart[order] < best[rows[order]]]
        best[rows[order]] = apart[order]
        nearest[rows[order]] = partner[candidates[order]]
    close = best <= 1.0
    worst = np.argsort(best, kind="stable")[: min(MAX_LISTED, int(close.sum()))]
    starts = np.searchsorted(labels.round, np.arange(len(rounds)))
    pairs = [
        _make_pair(labels, rounds, starts, int(near[i]), int(nearest[i]), best[i]) for i in worst
    ]
    return NearDuplicates(int(near.size), int(close.sum()), tuple(pairs))


def _scaled_poses(labels: Labels, tolerances: Tolerances) -> NDArray[np.float64]:
    """(N, 3): s, lateral offset and yaw, in units of their tolerances."""
    columns = (
        labels.s / tolerances.s_m,
        labels.to_middle / tolerances.to_middle_m,
        np.degrees(labels.angle) / tolerances.angle_deg,
    )
    return np.stack(columns, axis=1).astype(np.float64)


def _scene_numbers(labels: Labels, rounds: Sequence[RoundInfo]) -> NDArray[np.int64]:
    """(N,): a number for each combination of track, lanes and light."""
    numbers: dict[tuple[str, int], int] = {}
    of_round = [numbers.setdefault((r.track, r.lanes), len(numbers)) for r in rounds]
    kinds, light = np.unique(labels.light, return_inverse=True)
    return np.array(of_round, np.int64)[labels.round] * len(kinds) + light


def _grid_cells(
    poses: NDArray[np.float64], scenes: NDArray[np.int64]
) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """(N,) cell numbers, adjacent in yaw; and their strides in s and in lateral offset."""
    grid = np.floor(poses).astype(np.int64)
    grid -= grid.min(axis=0) - 1  # an empty cell on either side: strides never wrap around
    _, offsets, yaws = (int(size) + 2 for size in grid.max(axis=0))
    longest = int(grid[:, 0].max()) + 2
    s_step, offset_step = offsets * yaws, yaws
    cells = scenes * longest * s_step + grid[:, 0] * s_step + grid[:, 1] * offset_step + grid[:, 2]
    return cells, (s_step, offset_step)


def _candidate_pairs(
    cells: NDArray[np.int64], partners: NDArray[np.int64], strides: tuple[int, int]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Index pairs into `cells` and sorted `partners`, in equal or adjacent cells, in batches."""
    for s, offset in product((-1, 0, 1), repeat=2):
        middle = cells + s * strides[0] + offset * strides[1]
        low = np.searchsorted(partners, middle - 1, "left")
        counts = np.searchsorted(partners, middle + 1, "right") - low
        total = np.concatenate([[0], np.cumsum(counts)])
        first = 0
        while first < len(cells):
            last = int(np.searchsorted(total, total[first] + MAX_PAIRS_AT_ONCE, "right")) - 1
            last = max(last, first + 1)
            part = slice(first, last)
            rows = np.repeat(np.arange(first, last), counts[part])
            start = np.repeat(low[part] - (total[part] - total[first]), counts[part])
            yield rows, start + np.arange(len(rows))
            first = last


def _make_pair(
    labels: Labels,
    rounds: Sequence[RoundInfo],
    starts: NDArray[np.int64],
    one: int,
    other: int,
    distance: float,
) -> NearPair:
    number, other_number = int(labels.round[one]), int(labels.round[other])
    return NearPair(
        distance=round(float(distance), 4),
        round=rounds[number].id,
        frame=one - int(starts[number]),
        other_round=rounds[other_number].id,
        other_frame=other - int(starts[other_number]),
        track=rounds[number].track,
        s_m=round(float(labels.s[one]), 2),
    )
