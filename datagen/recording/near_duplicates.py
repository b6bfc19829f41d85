"""Finds near-duplicate frames on two sides of a split: same track and light, similar pose.

A test set with many near-duplicates of training frames measures memorisation.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.recording.labels import Labels
from datagen.recording.round_metadata import RoundInfo

MAX_LISTED = 10


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Largest differences between two near-duplicates: along the road (m), across it (m), and in
    the angle to the road (degrees)."""

    s_m: float = 0.5
    to_middle_m: float = 0.1
    angle_deg: float = 0.5


@dataclass(frozen=True, slots=True)
class NearPair:
    """A frame and the nearest frame of the other side of the split.

    `distance` is the largest of the differences in position, offset and angle, each divided by its
    tolerance: 0 means the same pose, 1 the limit. `s_m` is the position (m) of frame `frame` of
    round `round` on the lap.
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
    """Numbers of frames of one side: `frames` is the number of all frames, and `near` the number of
    frames with a near-duplicate on the other side. `worst` are the nearest pairs, at most 10
    (MAX_LISTED), the nearest first."""

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
    """Find near-duplicates of the frames in mask `side` (N,) among the frames in mask `other` (N,),
    where N is the number of frames in `labels`, the labels of `rounds`. `tolerances` are the
    largest differences between near-duplicates.

    Pairs across the start line are not found, because `s` jumps there from the lap's length to 0.
    """
    near, partner = np.flatnonzero(side), np.flatnonzero(other)
    if not (near.size and partner.size):
        return NearDuplicates(int(near.size), 0, ())
    poses = _scaled_poses(labels, rounds, tolerances)
    best, place = cKDTree(poses[partner]).query(poses[near], p=np.inf, distance_upper_bound=2.0)
    close = best <= 1.0
    worst = np.argsort(best, kind="stable")[: min(MAX_LISTED, int(close.sum()))]
    starts = np.searchsorted(labels.round, np.arange(len(rounds)))
    pairs = [
        _make_pair(labels, rounds, starts, int(near[i]), int(partner[place[i]]), best[i])
        for i in worst
    ]
    return NearDuplicates(int(near.size), int(close.sum()), tuple(pairs))


def _scaled_poses(
    labels: Labels, rounds: Sequence[RoundInfo], tolerances: Tolerances
) -> NDArray[np.float64]:
    """Return poses (N, 4) for a nearest-neighbour search: s, lateral offset and angle, each in
    units of its tolerance, and 10 times the number of the frame's combination of track, lanes and
    light. The fourth column separates frames of different combinations."""
    numbers: dict[tuple[str, int], int] = {}
    of_round = [numbers.setdefault((r.track, r.lanes), len(numbers)) for r in rounds]
    kinds, light = np.unique(labels.light, return_inverse=True)
    columns = (
        labels.s / tolerances.s_m,
        labels.to_middle / tolerances.to_middle_m,
        np.degrees(labels.angle) / tolerances.angle_deg,
        10 * (np.array(of_round)[labels.round] * len(kinds) + light),
    )
    return np.stack(columns, axis=1).astype(np.float64)


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
