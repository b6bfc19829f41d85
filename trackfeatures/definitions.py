"""Defines the track features: names, signs, ranges and limits. SI units, track frame.

Distances to markings are measured at the centre of gravity, in the road plane. They are negative
for a marking on the left of the car, positive for one on its right. Offsets from the centre of a
lane or of the road are positive if the car is on the left of it. Source: Li et al., "Reinforcement
Learning and Deep Learning based Lateral Control for Autonomous Driving", section V, after
DeepDriving (Chen et al. 2015).
"""

from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from trackfeatures.road_class import RoadClass

VERSION: Final = "2"
"""Version of these definitions; stored in every recording, model and answer."""

MARKINGS: Final = ("ml", "mr", "l", "m", "r")
"""In-lane system: `ml` and `mr` are the markings of the car's lane. On-marking system: `m` is the
marking nearest to the car; `l` and `r` are the next markings to the left and right of `m`."""

TARGETS: Final = (*MARKINGS, "angle")
"""The six regression targets of a network, in the order of its outputs."""

LANES: Final = (1, 2, 3)
LANE_WIDTH_M: Final = 4.0
LANE_WIDTH_LIMITS_M: Final = (2.7, 4.5)

IN_LANE_MARGIN_M: Final = 0.5
"""The in-lane system is active if the car is at least this far from both markings of its lane."""
ON_MARKING_REACH_M: Final = 1.2
"""The on-marking system is active if the car is at most this far from a marking."""
OUTSIDE_REACH_M: Final = 2.0
"""The on-marking system is also active if the car is at most this far outside the outermost
marking."""


@dataclass(frozen=True, slots=True)
class Range:
    """The range [lo, hi] of a network output in m or rad, and the value that encodes "absent"."""

    lo: float
    hi: float
    inactive: float | None


RANGES: Final = MappingProxyType(
    {
        # m, negative on the left of the car
        "ml": Range(-5.5, -0.5, inactive=-5.5),
        "mr": Range(0.5, 5.5, inactive=5.5),
        "l": Range(-7.0, -1.5, inactive=-7.0),
        "m": Range(-2.0, 3.5, inactive=3.5),
        "r": Range(1.5, 7.0, inactive=7.0),
        # rad, track tangent minus yaw: positive when the car points to the right of the track
        "angle": Range(-0.5, 0.5, inactive=None),
    }
)


@dataclass(frozen=True, slots=True)
class TrackFeatures:
    """The track features of one image or one moment."""

    ml: float | None
    """Distance from the car to the marking `ml` in m, negative if the marking is left of the car;
    None if it is absent. `mr`, `l`, `m` and `r` are distances with the same unit and sign."""
    mr: float | None
    l: float | None
    m: float | None
    r: float | None
    angle: float
    """Heading angle in rad, positive when the car points to the right of the track."""
    heading: RoadClass

    @property
    def distances(self) -> dict[str, float | None]:
        """The five distances by name, in the order of `MARKINGS`."""
        return {"ml": self.ml, "mr": self.mr, "l": self.l, "m": self.m, "r": self.r}

    @property
    def to_lane_centre(self) -> float | None:
        """Offset from the centre of the car's lane, or of the nearest lane, in m, left positive;
        None if no lane is visible."""
        return lane_offset(self.ml, self.mr, self.l, self.m, self.r)


def lane_offset(
    ml: float | None, mr: float | None, l: float | None, m: float | None, r: float | None
) -> float | None:
    """Return the car's offset from the centre of the nearest lane (m, left positive); None if no
    lane is visible.

    The arguments are the fields of `TrackFeatures`. The pair `ml`, `mr` has priority. Without this
    pair, the lane on the car's side of the marking `m` is used. If the car is outside the road,
    there is no lane on this side, so the lane on the far side of `m` is used.
    """
    if ml is not None and mr is not None:
        return (ml + mr) / 2
    if m is None:
        return None
    # If the marking is left of the car (m <= 0), the car's lane is right of the marking.
    near, far = (r, l) if m <= 0 else (l, r)
    neighbour = near if near is not None else far
    return None if neighbour is None else (m + neighbour) / 2
