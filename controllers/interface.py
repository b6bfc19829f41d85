"""The input and output of a controller. SI units, track frame, left positive."""

from dataclasses import dataclass
from typing import Protocol

from trackfeatures import RoadClass


@dataclass(frozen=True, slots=True)
class Observation:
    """One control step: the perceived road and the car's own sensors."""

    to_lane_centre: float
    """m from the centre of the lane to follow; the paper's e1."""
    angle: float
    """rad, track tangent minus yaw: positive when the car points to the right (minus e2)."""
    heading: RoadClass
    """Class of the road: left, straight or right."""
    vx: float
    """m/s, forward in the body frame."""
    vy: float
    """m/s, to the left in the body frame."""
    yaw_rate: float
    """rad/s, counter-clockwise."""
    curvature: float | None = None
    """1/m, left positive, of the road just ahead; None if it is not measured (on perception)."""


class Controller(Protocol):
    """A lateral controller. To add one, add a file to `laws` and an entry to `registry`."""

    def update(self, observation: Observation) -> float:
        """The steering action in [-1, 1], left positive; called once for each control step."""
        ...


@dataclass(frozen=True)
class LoopConfig:
    """The control loop of a controller."""

    dt: float
    """Duration of a control step, s."""
    noisy: bool = False
    """Whether a perception estimates the state, with errors; otherwise the state is exact."""
    delay_s: float | None = None
    """By how much the perceived offset and angle are late, s; None if it is unknown."""
