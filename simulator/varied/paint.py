"""The state of a road's paint in one scene: wear, missing pieces, arrows, crosswalks."""

from dataclasses import dataclass
from typing import Literal

ArrowKind = Literal["ahead", "left", "right"]


@dataclass(frozen=True, slots=True)
class Paint:
    """The paint of one scene; ranges.toml, section [paint], explains the values."""

    tone: float = 1.0
    wear: float = 0.0
    missing: float = 0.0
    gap_m: float = 0.0
    gap_every_m: float = 60.0
    gap_marking: int = 9
    arrow_every_m: float = 0.0
    arrow_kind: ArrowKind = "ahead"
    crosswalk_every_m: float = 0.0
    phase: float = 0.0
