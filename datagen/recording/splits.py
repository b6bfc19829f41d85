"""Which rounds train a model and which judge it: by round, never by frame.

`splits/NAME.json` holds the ids of both sides; nothing of one side may stand on the other.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import trackfeatures as tf

from .errors import DatasetError
from .folder import write_synced
from .index import RoundIndex

UNSEEN = "unseen"
SIDES = ("train", "test", UNSEEN)
"""`unseen`: rounds of a track that no model is trained on."""
DEFAULT_SPLIT = "default"


@dataclass(frozen=True, slots=True)
class RoundKey:
    """What makes two rounds the same one."""

    id: str
    seed: int
    content_hash: str


@dataclass(frozen=True, slots=True)
class Split:
    train: tuple[str, ...]
    test: tuple[str, ...]
    unseen: tuple[str, ...] = ()
    recovered: tuple[str, ...] = ()
    """Rounds on any side that are known to be saved from damaged files."""

    def side(self, round_id: str) -> str:
        """Rounds in neither list belong to no side."""
        return next((side for side in SIDES if round_id in getattr(self, side)), "")


def split_path(folder: Path, name: str = DEFAULT_SPLIT) -> Path:
    return folder / "splits" / f"{name}.json"


def read_split(path: Path) -> Split:
    try:
        found = json.loads(path.read_text())
        tf.require_version(str(found["definitions"]), str(path))
        return Split(
            **{side: tuple(found[side]) for side in SIDES},
            recovered=tuple(found.get("recovered", ())),
        )
    except FileNotFoundError as error:
        raise DatasetError(
            f"there is no split at {path}; expected a JSON file with the lists {', '.join(SIDES)}"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path} is no split: expected JSON with definitions, {', '.join(SIDES)} ({error!r})"
        ) from error


def write_split(path: Path, split: Split) -> None:
    content = {"definitions": tf.VERSION} | {side: list(getattr(split, side)) for side in SIDES}
    if split.recovered:
        content["recovered"] = list(split.recovered)
    write_synced(path, json.dumps(content, indent=1) + "\n")


def require_disjoint(split: Split, rounds: Iterable[RoundKey]) -> None:
    """Raise DatasetError when a round, a seed or a content stands on both sides."""
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


def require_known_recovered(split: Split, rounds: Iterable[RoundIndex]) -> None:
    """Raise DatasetError when a recovered round stands on a side and the split does not say so."""
    for index in rounds:
        round_id = index.header.id
        if index.recovery and split.side(round_id) and round_id not in split.recovered:
            raise DatasetError(
                f"round {round_id} was recovered from a damaged file ({index.recovery}) and the "
                "split does not say that it takes such rounds; record it again, or make a split "
                "with `datagen split --with-recovered`"
            )


def _leak(what: str, which: str, one: str, other: str) -> DatasetError:
    return DatasetError(
        f"the split has {what} {which} on both sides, {one} and {other}: a model would be judged "
        "on what it has seen; change the split file so that each stands on one side only"
    )
