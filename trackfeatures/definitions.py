"""What a track feature is: names, signs, ranges and limits. SI units, track frame, left positive.

Distances to markings are taken at the centre of gravity, in the road plane: negative for a marking
on the left of the car, positive for one on its right. Source: Li et al., "Reinforcement Learning
and Deep Learning based Lateral Control for Autonomous Driving", section V, after DeepDriving
(Chen et al. 2015).
"""

from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Final

VERSION: Final = "1"
"""Of these definitions; stored in every recording, model and answer."""


class Heading(IntEnum):
    """Where the track turns, the paper's third task."""

    LEFT = 0
    STRAIGHT = 1
    RIGHT = 2


MARKINGS: Final = ("ml", "mr", "l", "m", "r")
"""In-lane system: `ml`, `mr`, the markings of the car's lane. On-marking system: `m`, the marking
the car drives on, `l` and `r`, the next ones beside it."""

TARGETS: Final = (*MARKINGS, "angle")


@dataclass(frozen=True, slots=True)
class Range:
    """The values [lo, hi] a network output can tell, and the one that stands for "absent"."""

    lo: float
    hi: float
    inactive: float | None


RANGES: Final = MappingProxyType(
    {
        "ml": Range(-5.5, -0.5, inactive=-5.5),
        "mr": Range(0.5, 5.5, inactive=5.5),
        "l": Range(-7.0, -1.5, inactive=-7.0),
        "m": Range(-2.0, 3.5, inactive=3.5),
        "r": Range(1.5, 7.0, inactive=7.0),
        "angle": Range(-0.5, 0.5, inactive=None),
    }
)

IN_LANE_MARGIN_M: Final = 0.5
"""The in-lane system is active at least this far from both markings of the lane."""
ON_MARKING_REACH_M: Final = 1.2
"""The on-marking system is active within this distance of a marking..."""
OUTSIDE_REACH_M: Final = 2.0
"""...and within this one on the outer side of an outermost marking."""

BEND_CURVATURE: Final = 1.0 / 170.0
"""1/m; a gentler bend counts as straight."""
LOOK_AHEAD_M: Final = 20.0
"""Where the car's own place is straight, the class is that of the track so far ahead."""

LANE_WIDTH_M: Final = 4.0
LANE_WIDTH_LIMITS_M: Final = (3.0, 4.5)
LANES: Final = (1, 2, 3)


# The track features of one moment.


@dataclass(frozen=True, slots=True)
class TrackFeatures:
    """Distances to markings (m, left negative, None where absent), heading angle (rad, positive
    when the car points to the right of the track), class of the track's heading."""

    ml: float | None
    mr: float | None
    l: float | None
    m: float | None
    r: float | None
    angle: float
    heading: Heading

    @property
    def distances(self) -> dict[str, float | None]:
        """The five distances by name, in the order of `MARKINGS`."""
        return {"ml": self.ml, "mr": self.mr, "l": self.l, "m": self.m, "r": self.r}

    @property
    def to_lane_centre(self) -> float | None:
        """Offset from the centre of the lane the car is in or nearest to (m, left positive)."""
        if self.ml is not None and self.mr is not None:
            return (self.ml + self.mr) / 2
        if self.m is None:
            return None
        # A marking on the car's left has the car's lane on its right, and the other way round.
        first, second = (self.r, self.l) if self.m <= 0 else (self.l, self.r)
        neighbour = first if first is not None else second
        return None if neighbour is None else (self.m + neighbour) / 2
