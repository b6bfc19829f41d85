"""What a controller receives and returns. SI units, track frame, left positive."""

from dataclasses import dataclass
from typing import Protocol

from trackfeatures import RoadClass


@dataclass(frozen=True, slots=True)
class Observation:
    """One control step: the perceived road and the car's own sensors."""

    to_lane_centre: float
    """m from the middle of the lane to follow; the paper's e1."""
    angle: float
    """rad, track tangent minus yaw: positive when the car points to the right (minus e2)."""
    heading: RoadClass
    vx: float
    """m/s, forward in the body frame."""
    vy: float
    """m/s, to the left in the body frame."""
    yaw_rate: float
    """rad/s, counter-clockwise."""
    curvature: float | None = None
    """1/m, left positive, of the road just ahead; None where it is not measured (perception)."""


class Controller(Protocol):
    """A lateral controller. A new one is a new file and one entry in `registry`."""

    def update(self, observation: Observation) -> float:
        """The steering action in [-1, 1], left positive; called once a control step."""
        ...


@dataclass(frozen=True)
class LoopConfig:
    """The control loop that a controller is made for."""

    dt: float
    """s between two control steps."""
    noisy: bool = False
    """Whether the state is estimated by a perception, with errors, or exact."""
