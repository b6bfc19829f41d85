"""Which rounds train a model and which judge it: by round, never by frame.

`splits/NAME.json` holds the ids of both sides; nothing of one side may stand on the other.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import trackfeatures as tf

from .errors import DatasetError
from .folder import write_synced

SIDES = ("train", "test")
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

    def side(self, round_id: str) -> str:
        """Rounds in neither list belong to no side."""
        if round_id in self.test:
            return "test"
        return "train" if round_id in self.train else ""


def split_path(folder: Path, name: str = DEFAULT_SPLIT) -> Path:
    return folder / "splits" / f"{name}.json"


def read_split(path: Path) -> Split:
    try:
        found = json.loads(path.read_text())
        tf.require_version(str(found["definitions"]), str(path))
        return Split(train=tuple(found["train"]), test=tuple(found["test"]))
    except FileNotFoundError as error:
        raise DatasetError(
            f"there is no split at {path}; expected a JSON file with the lists train and test"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path} is no split: expected JSON with definitions, train and test ({error!r})"
        ) from error


def write_split(path: Path, split: Split) -> None:
    content = {
        "definitions": tf.VERSION,
        "train": list(split.train),
        "test": list(split.test),
    }
    write_synced(path, json.dumps(content, indent=1) + "\n")


def require_disjoint(split: Split, rounds: Iterable[RoundKey]) -> None:
    """Raise DatasetError when a round, a seed or a content stands on both sides."""
    both = set(split.train) & set(split.test)
    if both:
        raise _leak("round", sorted(both)[0])
    keys = list(rounds)
    train = [key for key in keys if split.side(key.id) == "train"]
    test = [key for key in keys if split.side(key.id) == "test"]
    seeds = {key.seed for key in train} & {key.seed for key in test}
    if seeds:
        raise _leak("seed", str(min(seeds)))
    contents = {key.content_hash for key in train} & {key.content_hash for key in test}
    if contents:
        raise _leak("content", min(contents)[:12])


def _leak(what: str, which: str) -> DatasetError:
    return DatasetError(
        f"the split has {what} {which} on both sides, train and test: a model would be judged on "
        "what it has seen; change the split file so that each stands on one side only"
    )
