"""Chooses the rounds of a plan that are held out for testing: about the same share of the rounds of
every track, lane count, trajectory and light."""

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
    """Choose the test rounds, about `test_share` (0 to below 1) of all rounds; return their
    indices.

    `tracks`, `lanes` and each sequence in `attributes` have one value for each round. The test
    rounds are spread evenly over the tracks first, then over lane counts and `attributes`. A random
    number for each round breaks ties.

    Every track with at least three rounds is on both sides, even if this takes more test rounds
    than `test_share`. The last training round of a track is chosen only if no other track has two
    training rounds left. The same rule applies to roads (a road is a track with one lane count).
    The reason is that tests on roads without training rounds belong to the side `unseen`.
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
        # Only rounds of the best roads can be chosen. There are fewer roads than rounds, so it is
        # faster to compare the roads first.
        best_roads = _best_roads(road, track, track_of_road)
        open_rounds = np.flatnonzero(in_training & best_roads[road.of])
        # The shares are added from left to right. Another order could round differently, and then
        # other rounds would be chosen.
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
        # Index of the group of each round.
        self.of: IntArray = np.array([numbers[value] for value in values])
        self.size: IntArray = np.bincount(self.of)
        self.tested: IntArray = np.zeros_like(self.size)

    def tested_share(self) -> NDArray[np.float64]:
        return np.asarray(self.tested / self.size)

    def in_training(self) -> IntArray:
        return self.size - self.tested


def _best_roads(road: _Groups, track: _Groups, track_of_road: IntArray) -> NDArray[np.bool_]:
    """Return a mask (roads,) of the roads from which the next test round can be taken. These roads
    have the lowest penalty and, among the roads with this penalty, the track with the lowest share
    of test rounds. `track_of_road` (roads,) is the index of each road's track."""
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
