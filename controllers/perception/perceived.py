"""The output of a perception: the road as a controller receives it. m, rad, 1/m; left positive."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from trackfeatures import RoadClass

if TYPE_CHECKING:
    from simulator.world.world import World


@dataclass(frozen=True, slots=True)
class Perceived:
    """The road at one control step."""

    to_lane_centre: float | None
    """m from the centre of the lane to follow; None if no marking is visible."""
    angle: float
    """rad, positive when the car points to the right of the track."""
    heading: RoadClass
    curvature: float | None = None
    """1/m, of the road just ahead; None if the perception does not estimate it."""
    lost_s: float = 0.0
    """How long answers have been overdue or untrusted, s; 0 if the answer of this step arrived."""
    offset_std_m: float | None = None
    """Standard deviation of the error of `to_lane_centre`; None if it is not estimated."""
    angle_std_rad: float | None = None
    """Standard deviation of the error of `angle`; None if it is not estimated."""
    out_of_distribution: bool = False
    """Whether the image is unlike the images that the model was trained on."""


class Perceive(Protocol):
    """A function that measures or estimates the road at the present state of the world."""

    def __call__(self, world: "World") -> Perceived: ...
