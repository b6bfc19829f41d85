"""Which rounds an export takes, and in which order: train rounds first, then test, then others."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from datagen.recording.dataset import Dataset
from datagen.recording.round_metadata import RoundInfo
from datagen.recording.splits import SIDES
from datagen.view.steps import Steps

Progress = Callable[[int], None]
"""Hears how many frames are written."""

NO_SIDE = "unsplit"
"""What rounds are called that the split gives to no side."""


@dataclass(frozen=True, slots=True)
class Side:
    """The rounds of one side of the split, in order of their names."""

    name: str
    rounds: tuple[RoundInfo, ...]

    @property
    def frames(self) -> int:
        return sum(info.frames for info in self.rounds)

    def open(self) -> Iterator[tuple[RoundInfo, Steps]]:
        """Each round, opened when its turn comes."""
        for info in self.rounds:
            yield info, Steps.open(info.path)


def sides(dataset: Dataset, wanted: str) -> list[Side]:
    """Sides that have rounds, of `wanted`: one of them or all; DatasetError when there are none."""
    chosen = dataset.select(wanted).rounds
    found = [
        Side(name or NO_SIDE, tuple(info for info in chosen if info.split == name))
        for name in (*SIDES, "")
    ]
    return [side for side in found if side.rounds]
