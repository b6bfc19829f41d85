"""What in a dataset would make a model worse, said in plain sentences."""

from collections.abc import Iterable, Iterator
from typing import Any

from datagen.recording.round_metadata import RoundInfo

LEAST_CLASS_SHARE = 0.15
LEAST_ACTIVE_SHARE = 0.02
KINDS = ("track", "lanes", "light", "trajectory")
NEEDED = ("train", "test")
"""Sides that every dataset needs; `unseen` is collected on request, and differs on purpose."""


def concerns(statistics: dict[str, Any], rounds: Iterable[RoundInfo]) -> list[str]:
    """Sentences on `datagen.recording.statistics.describe`; none when nothing is to be said."""
    known = list(rounds)
    return [*_empty_sides(statistics), *_rare(statistics), *_one_sided(known)]


def _empty_sides(statistics: dict[str, Any]) -> Iterator[str]:
    for side in NEEDED:
        if not statistics[side]["frames"]:
            yield f"No round is for {side}: collect more rounds or make another split."


def _rare(statistics: dict[str, Any]) -> Iterator[str]:
    for side in NEEDED:
        if not statistics[side]["frames"]:
            continue
        for name, share in statistics[side]["heading"].items():
            if share < LEAST_CLASS_SHARE:
                yield (
                    f"Class {name} has {share:.1%} of the {side} frames, less than "
                    f"{LEAST_CLASS_SHARE:.0%}: a model may learn to leave it out."
                )
        for name, share in statistics[side]["active"].items():
            if share < LEAST_ACTIVE_SHARE:
                yield f"{name} is active in {share:.1%} of the {side} frames: too few to judge by."


def _one_sided(rounds: list[RoundInfo]) -> Iterator[str]:
    """What one side of the split has and the other has not."""
    sides = {side: [info for info in rounds if info.split == side] for side in NEEDED}
    if not all(sides.values()):
        return
    for kind in KINDS:
        train, test = ({k for i in sides[side] for k in i.values_of(kind)} for side in NEEDED)
        for only, other, side in ((train - test, "test", "train"), (test - train, "train", "test")):
            if only:
                names = ", ".join(sorted(only))
                yield f"{kind.capitalize()} {names}: in {side} rounds only, in no {other} round."
