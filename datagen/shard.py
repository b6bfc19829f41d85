"""A part of a plan, for batch systems: `--shard 2/4` records every fourth round from the second."""

import re
from dataclasses import dataclass

from datagen.plan import RoundPlan
from trackfeatures.errors import UserError


@dataclass(frozen=True, slots=True)
class Shard:
    """Number `number` (from 1) of `count`."""

    number: int
    count: int

    @staticmethod
    def parse(text: str) -> "Shard":
        found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text.strip())
        shard = Shard(int(found[1]), int(found[2])) if found else Shard(0, 0)
        if not 1 <= shard.number <= shard.count:
            raise UserError(f"--shard is {text!r}; give its number and how many, as 1/4 to 4/4")
        return shard

    def of(self, rounds: tuple[RoundPlan, ...]) -> tuple[RoundPlan, ...]:
        return rounds[self.number - 1 :: self.count]

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"
