"""Sorts the rounds of an export by side: train, test, unseen, then rounds on no side."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from datagen.recording.dataset import Dataset
from datagen.recording.names import SIDES
from datagen.recording.round_metadata import RoundInfo
from datagen.view.steps import Steps

Progress = Callable[[int], None]
"""Called with the number of frames written so far."""

NO_SIDE = "unsplit"
"""Name of the side for rounds that are on no side of the split."""


@dataclass(frozen=True, slots=True)
class Side:
    """The rounds on one side of the split, sorted by name."""

    name: str
    rounds: tuple[RoundInfo, ...]

    @property
    def frames(self) -> int:
        return sum(info.frames for info in self.rounds)

    def open(self) -> Iterator[tuple[RoundInfo, Steps]]:
        """Yield each round with its steps; a round is opened when the iteration reaches it."""
        for info in self.rounds:
            yield info, Steps.open(info.path)


def sides(dataset: Dataset, split: str) -> list[Side]:
    """Return the sides that have rounds; only the side `split` unless it is "all". Raises
    DatasetError if there is no round."""
    chosen = dataset.select(split).rounds
    found = [
        Side(name or NO_SIDE, tuple(info for info in chosen if info.split == name))
        for name in (*SIDES, "")
    ]
    return [side for side in found if side.rounds]
