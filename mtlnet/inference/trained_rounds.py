"""Reads and writes the entries of a model's card about the rounds of its training. Seeds are stored
as ranges, names as a digest.

A card of format 5, and a `config.json` written at the time of that format, list every seed and
every name; `shortened` accepts both forms.
"""

import hashlib
import json
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Seeds:
    """A set of seeds of rounds, stored as ranges, because the seeds of a collection are
    consecutive."""

    ranges: tuple[range, ...]
    """Disjoint ranges in ascending order, with a gap between neighbours."""

    @staticmethod
    def of(seeds: Iterable[int]) -> "Seeds":
        """Return the set of the given seeds."""
        return _merged(range(seed, seed + 1) for seed in seeds)

    @staticmethod
    def read(entry: Mapping[str, Any] | Iterable[int]) -> "Seeds":
        """Read the set of seeds from `entry`, a result of `Seeds.entry` or a list of seeds (format
        5). Raises ValueError for a damaged entry."""
        if not isinstance(entry, Mapping):
            return Seeds.of(entry)
        seeds = _merged(_range(text) for text in entry["ranges"].split())
        if seeds.count != entry["count"]:
            raise ValueError(f"{seeds.count} seeds instead of {entry['count']}")
        return seeds

    def entry(self) -> dict[str, Any]:
        """Return the entry for a card, such as {"count": 4, "ranges": "1..3 7"}. Both ends belong
        to a range."""
        texts = [
            f"{part.start}..{part[-1]}" if part[1:] else str(part.start) for part in self.ranges
        ]
        return {"count": self.count, "ranges": " ".join(texts)}

    @property
    def count(self) -> int:
        """Number of seeds."""
        return sum(part.stop - part.start for part in self.ranges)

    def __contains__(self, seed: int) -> bool:
        before = bisect_right(self.ranges, seed, key=lambda part: part.start)
        return before > 0 and seed in self.ranges[before - 1]

    def __or__(self, other: "Seeds") -> "Seeds":
        return _merged((*self.ranges, *other.ranges))


def _range(text: str) -> range:
    first, _, last = text.partition("..")
    part = range(int(first), int(last or first) + 1)
    if not part:
        raise ValueError(f"{text} has no seeds")
    return part


def _merged(parts: Iterable[range]) -> Seeds:
    """Return the set of all seeds in `parts`, which may overlap."""
    merged: list[range] = []
    for part in sorted(parts, key=lambda part: part.start):
        if merged and part.start <= merged[-1].stop:
            merged[-1] = range(merged[-1].start, max(merged[-1].stop, part.stop))
        else:
            merged.append(part)
    return Seeds(tuple(merged))


def names_entry(names: Iterable[str]) -> dict[str, Any]:
    """Return the entry of a card for names of rounds: their number, and the SHA-256 of the sorted
    names as JSON. With a list of names anyone can check whether they are the same rounds."""
    ordered = sorted(names)
    digest = hashlib.sha256(json.dumps(ordered).encode()).hexdigest()
    return {"count": len(ordered), "sha256": digest}


def shortened(about: Mapping[str, Any]) -> dict[str, Any]:
    """Return `about`, a card's description of training data or of the fit of the uncertainty head,
    with lists of rounds replaced by short entries. Raises ValueError, KeyError or TypeError if it
    is damaged."""
    short = dict(about)
    if "seeds" in about:
        short["seeds"] = Seeds.read(about["seeds"]).entry()
    if "held_out" in about:
        short["held_out"] = _short_names(about["held_out"])
    if "split" in about:
        short["split"] = {side: _short_names(names) for side, names in about["split"].items()}
    return short


def _short_names(names: Mapping[str, Any] | Iterable[str]) -> dict[str, Any]:
    return dict(names) if isinstance(names, Mapping) else names_entry(names)
