"""Reads, writes, checks and creates splits, which assign rounds to the sides train, test, unseen.

A split is by round, never by frame. `splits/NAME.json` holds the ids of each side. No round, seed
or content hash may be on two sides (a leak).
"""

import json
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import floor
from pathlib import Path

import numpy as np

import trackfeatures as tf
from datagen.recording.errors import MAKE_AGAIN, DatasetError
from datagen.recording.folder import write_if_changed
from datagen.recording.mcap.index import RoundIndex
from datagen.recording.names import SIDES
from datagen.recording.round_metadata import RoundInfo
from trackfeatures.names import require_name

DEFAULT_SPLIT = "default"


@dataclass(frozen=True, slots=True)
class RoundKey:
    """Identity of a round. Two rounds that share one of these values must be on the same side."""

    id: str
    seed: int
    content_hash: str


@dataclass(frozen=True, slots=True)
class Split:
    """Round ids of each side."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    unseen: tuple[str, ...] = ()
    recovered: tuple[str, ...] = ()
    """Rounds on any side that were recovered from damaged files and are used nevertheless."""

    def side(self, round_id: str) -> str:
        """Return the name of the side that the round is on; empty if it is on none."""
        return next((side for side in SIDES if round_id in getattr(self, side)), "")


def split_path(folder: Path, name: str = DEFAULT_SPLIT) -> Path:
    """Return the path of the split file. Raises BadName if the name cannot be a file name."""
    return folder / "splits" / f"{require_name(name, 'split name')}.json"


def read_split(path: Path) -> Split:
    """Read a split file. Raises DatasetError if it is missing or damaged, and DefinitionsMismatch
    if it was written under other definitions."""
    try:
        found = json.loads(path.read_text())
        tf.require_version(str(found["definitions"]), str(path))
        return Split(
            **{side: _round_ids(found[side]) for side in SIDES},
            recovered=_round_ids(found.get("recovered", ())),
        )
    except FileNotFoundError as error:
        raise DatasetError(
            f"there is no split at {path}; expected a JSON file with the lists {', '.join(SIDES)}"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path} is no split: expected JSON with definitions, {', '.join(SIDES)} ({error!r}); "
            "correct the file, or delete it"
        ) from error


def _round_ids(found: Iterable[object]) -> tuple[str, ...]:
    return tuple(require_name(round_id, "round id") for round_id in found)


def write_split(path: Path, split: Split) -> None:
    content = {"definitions": tf.VERSION} | {side: list(getattr(split, side)) for side in SIDES}
    if split.recovered:
        content["recovered"] = list(split.recovered)
    write_if_changed(path, json.dumps(content, indent=1) + "\n")


def require_disjoint(split: Split, rounds: Iterable[RoundKey]) -> None:
    """Raise DatasetError if a round, a seed or a content hash is on two sides."""
    keys = list(rounds)
    for one, other in combinations(SIDES, 2):
        both = set(getattr(split, one)) & set(getattr(split, other))
        if both:
            raise _leak("round", min(both), one, other)
        here = [key for key in keys if split.side(key.id) == one]
        there = [key for key in keys if split.side(key.id) == other]
        if seeds := {key.seed for key in here} & {key.seed for key in there}:
            raise _leak("seed", str(min(seeds)), one, other)
        if contents := {key.content_hash for key in here} & {key.content_hash for key in there}:
            raise _leak("content", min(contents)[:12], one, other)


def require_recovered_declared(split: Split, rounds: Iterable[RoundIndex], path: Path) -> None:
    """Raise DatasetError if a recovered round is on a side but not in `split.recovered`. `path` is
    the file of the split, for the message."""
    for index in rounds:
        round_id = index.header.id
        if index.recovery and split.side(round_id) and round_id not in split.recovered:
            raise DatasetError(
                f"round {round_id} was recovered from a damaged file ({index.recovery}), and the "
                f"split does not list it as recovered; {MAKE_AGAIN}, which lists it in the split "
                f'{DEFAULT_SPLIT!r}, or add "{round_id}" to the list "recovered" in {path}'
            )


def _leak(what: str, which: str, one: str, other: str) -> DatasetError:
    return DatasetError(
        f"the split has {what} {which} on both sides, {one} and {other}: a model would be tested "
        "on data it was trained on; change the split file so that it is on one side only"
    )


SPLIT_BY = ("round", "track")


def split_rounds(rounds: Sequence[RoundInfo], by: str, test_share: float, seed: int) -> Split:
    """Create a random split of `rounds` with about `test_share` of the rounds on the test side.

    If `by` is "round", every track with enough rounds is on both sides; if it is "track", a track
    is on one side only. Rounds that share a seed or a content hash stay together. Raises
    DatasetError for another `by`, a share outside 0 to 1 or a negative seed, or if a side would be
    empty.
    """
    if by not in SPLIT_BY:
        raise DatasetError(f"rounds cannot be divided by {by!r}; choose {' or '.join(SPLIT_BY)}")
    if not 0.0 < test_share < 1.0:
        raise DatasetError(f"--test-share is {test_share:g}; give a number between 0 and 1")
    if seed < 0:
        raise DatasetError(f"--seed is {seed}; give 0 or more")
    rng = np.random.default_rng(seed)
    groups = _inseparable_groups(rounds, by)
    if by == "track":
        order = [groups[i] for i in rng.permutation(len(groups))]
    else:
        order = _order_by_track(groups, rng)
    # Group n is a test group if round(n * test_share) < round((n + 1) * test_share).
    # With rounding to the nearest integer, the first and the last group have equal chances.
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


def _order_by_track(
    groups: list[list[RoundInfo]], rng: np.random.Generator
) -> list[list[RoundInfo]]:
    """Return the groups sorted by track, in random order within a track. Groups selected at equal
    distances in this list cover all tracks."""
    tracks: dict[str, list[list[RoundInfo]]] = defaultdict(list)
    for i in rng.permutation(len(groups)):
        tracks[groups[i][0].track].append(groups[i])
    return [group for track in sorted(tracks) for group in tracks[track]]


def _inseparable_groups(rounds: Sequence[RoundInfo], by: str) -> list[list[RoundInfo]]:
    """Return the groups of rounds that must be on the same side, sorted by the id of their first
    round. Rounds of a group share a seed, a content hash or, if `by` is "track", a track."""
    groups: list[list[RoundInfo]] = []
    keys: list[set[object]] = []
    for info in rounds:
        own: set[object] = {("seed", info.seed), ("content", info.content_hash)}
        if by == "track":
            own.add(("track", info.track))
        members = [info]
        for i in reversed(range(len(groups))):
            if keys[i] & own:
                members = groups.pop(i) + members
                own |= keys.pop(i)
        groups.append(members)
        keys.append(own)
    return sorted(groups, key=lambda group: group[0].id)
