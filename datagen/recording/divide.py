"""Making a split: which rounds train and which judge, by round or by track.

Rounds that share a seed or a content go to the same side together.
"""

from collections import defaultdict
from collections.abc import Sequence
from math import floor

import numpy as np

from .errors import DatasetError
from .header import RoundInfo
from .splits import Split

KINDS = ("round", "track")


def divide(rounds: Sequence[RoundInfo], by: str, test_share: float, seed: int) -> Split:
    """A split of `rounds` with about `test_share` of them to test.

    By round, every track stands on both sides as far as it has rounds enough; by track, whole
    tracks are held back. DatasetError when a side would be empty.
    """
    if by not in KINDS:
        raise DatasetError(f"rounds cannot be divided by {by!r}; choose {' or '.join(KINDS)}")
    if not 0.0 < test_share < 1.0:
        raise DatasetError(f"a test share of {test_share:g} is none; give one between 0 and 1")
    rng = np.random.default_rng(seed)
    groups = _bound(rounds, by)
    if by == "track":
        order = [groups[i] for i in rng.permutation(len(groups))]
    else:
        order = _by_track(groups, rng)
    # The n-th group is for testing where the share of the groups so far passes a whole number; the
    # first half a step later, so that neither end of the order is favoured.
    marks = [floor((n * test_share) + 0.5) for n in range(len(order) + 1)]
    chosen = [group for n, group in enumerate(order) if marks[n + 1] > marks[n]]
    if not chosen and len(order) > 1:
        chosen = [order[-1]]
    if not chosen or len(chosen) == len(order):
        raise DatasetError(
            f"{len(order)} {by}s that share no seed or content are too few for two sides with a "
            f"test share of {test_share:g}; collect more, or choose another share"
        )
    test = {info.id for group in chosen for info in group}
    ids = [info.id for info in rounds]
    return Split(tuple(i for i in ids if i not in test), tuple(i for i in ids if i in test))


def _by_track(groups: list[list[RoundInfo]], rng: np.random.Generator) -> list[list[RoundInfo]]:
    """Track after track, in each in random order: an even walk through it takes of every track."""
    tracks: dict[str, list[list[RoundInfo]]] = defaultdict(list)
    for i in rng.permutation(len(groups)):
        tracks[groups[i][0].track].append(groups[i])
    return [group for track in sorted(tracks) for group in tracks[track]]


def _bound(rounds: Sequence[RoundInfo], by: str) -> list[list[RoundInfo]]:
    """Rounds that must stay together, each group once, in order of their first rounds."""
    groups: list[list[RoundInfo]] = []
    keys: list[set[object]] = []
    for info in rounds:
        mine: set[object] = {("seed", info.seed), ("content", info.content_hash)}
        if by == "track":
            mine.add(("track", info.track))
        members = [info]
        for i in reversed(range(len(groups))):
            if keys[i] & mine:
                members = groups.pop(i) + members
                mine |= keys.pop(i)
        groups.append(members)
        keys.append(mine)
    return sorted(groups, key=lambda group: group[0].id)
