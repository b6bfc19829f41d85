"""The output of a perception, which a controller receives. SI units, left positive."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from trackfeatures import RoadClass

if TYPE_CHECKING:
    from simulator.world.world import World


@dataclass(frozen=True, slots=True)
class Perceived:
    """The road at one control step, as a perception measures or estimates it."""

    to_lane_centre: float | None
    """Offset (m) from the centre of the lane to follow; None if no marking is visible."""
    angle: float
    """Heading angle, rad, positive when the car points to the right of the track."""
    heading: RoadClass
    curvature: float | None = None
    """Curvature (1/m) of the road just ahead; None if the perception does not estimate it."""
    lost_s: float = 0.0
    """Time (s) for which answers have been late or have had little weight; 0 if the answer for this
    control step arrived in time and is trusted."""
    offset_std_m: float | None = None
    """Standard deviation of the error of `to_lane_centre`; None if it is not estimated."""
    angle_std_rad: float | None = None
    """Standard deviation of the error of `angle`; None if it is not estimated."""
    out_of_distribution: bool = False
    """Whether the image is unlike the images that the model was trained on."""


class Perceive(Protocol):
    """A function that measures or estimates the road at the present state of the world."""

    def __call__(self, world: "World") -> Perceived: ...
