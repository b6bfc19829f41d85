"""Chooses the rounds of a plan that are held out for testing: the same share of every track, lane
count, trajectory and light."""

from collections import Counter
from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]


def choose_test_rounds(
    test_share: float,
    tracks: Sequence[str],
    lanes: Sequence[int],
    attributes: Sequence[Sequence[Hashable]],
    rng: np.random.Generator,
) -> set[int]:
    """Numbers of the rounds to test on: about `test_share` (0 to below 1) of all.

    `tracks`, `lanes` and each sequence in `attributes` have one value for each round. The
    rounds are spread evenly over the tracks first, then over lane counts and `attributes`; ties are
    broken by one draw of `rng` for each round.

    Every track with three rounds or more is on both sides, even if this takes more test rounds than
    the share. No track gives up its last training round while another has two, and no road (a track
    with one lane count) its last one while another road has two: roads that were never trained on
    are what `unseen` rounds are for.
    """
    count = len(tracks)
    if test_share == 0.0 or count < 2:
        return set()
    track = _Groups(tracks)
    road = _Groups(list(zip(tracks, lanes, strict=True)))
    others = [_Groups(values) for values in (lanes, *attributes)]
    track_of_road = np.zeros(len(road.size), np.int64)
    track_of_road[road.of] = track.of
    draw = rng.uniform(size=count)
    in_training = np.ones(count, bool)
    chosen: set[int] = set()
    for _ in range(_number_of_test_rounds(test_share, tracks)):
        # Only rounds of the best roads can be chosen: compare roads first, there are few of them.
        best_roads = _best_roads(road, track, track_of_road)
        open_rounds = np.flatnonzero(in_training & best_roads[road.of])
        # Summed from left to right: another order could round otherwise and choose other rounds.
        shares = sum(group.tested_share()[group.of[open_rounds]] for group in others)
        ties = open_rounds[shares == np.min(shares)]
        number = int(ties[np.argmin(draw[ties])])
        chosen.add(number)
        in_training[number] = False
        for group in (track, road, *others):
            group.tested[group.of[number]] += 1
    return chosen


class _Groups:
    """Rounds grouped by equal value, with the numbers of rounds and test rounds in each group."""

    def __init__(self, values: Sequence[Hashable]) -> None:
        numbers = {value: number for number, value in enumerate(dict.fromkeys(values))}
        self.of: IntArray = np.array([numbers[value] for value in values])  # each round's group
        self.size: IntArray = np.bincount(self.of)
        self.tested: IntArray = np.zeros_like(self.size)

    def tested_share(self) -> NDArray[np.float64]:
        return np.asarray(self.tested / self.size)

    def in_training(self) -> IntArray:
        return self.size - self.tested


def _best_roads(road: _Groups, track: _Groups, track_of_road: IntArray) -> NDArray[np.bool_]:
    """Mask of the roads from which the next test round is taken; all of them are equally good."""
    left = road.in_training()
    last_of_track = (track.in_training() == 1)[track_of_road]
    penalty = 2 * last_of_track + (left == 1) + 4 * (left == 0)
    best = penalty == penalty.min()
    share = track.tested_share()[track_of_road]
    return np.asarray(best & (share == share[best].min()))


def _number_of_test_rounds(test_share: float, tracks: Sequence[str]) -> int:
    wanted = max(round(len(tracks) * test_share), 1)
    wanted = max(wanted, sum(count >= 3 for count in Counter(tracks).values()))
    return min(wanted, len(tracks) - 1)
