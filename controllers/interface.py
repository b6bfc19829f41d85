"""The input and output of a controller. SI units, track frame, left positive."""

from dataclasses import dataclass, fields
from operator import attrgetter
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from trackfeatures import RoadClass


@dataclass(frozen=True, slots=True)
class Observation:
    """The input of a controller in one control step: the perceived road and the measurements of the
    car's own sensors."""

    to_lane_centre: float
    """Offset (m, left positive) from the centre of the lane to follow; the paper's e1."""
    angle: float
    """Track tangent minus yaw, rad: positive when the car points to the right; the paper's -e2."""
    heading: RoadClass
    """Class of the road: left, straight or right."""
    vx: float
    """Forward speed in the body frame, m/s."""
    vy: float
    """Speed to the left in the body frame, m/s."""
    yaw_rate: float
    """Yaw rate, rad/s, counter-clockwise."""
    curvature: float | None = None
    """Curvature (1/m, left positive) of the road just ahead; None if a model perceives the road,
    because a model does not predict the curvature."""


_values = attrgetter(*(field.name for field in fields(Observation)))
TO_LANE_CENTRE, ANGLE, HEADING, VX, VY, YAW_RATE, CURVATURE = range(7)
"""Indices of the columns of `Observations.rows`, for compiled code."""
OBSERVED = len(fields(Observation))


class _Column:
    """A descriptor that returns the column `index` of `Observations.rows`, an array (N,)."""

    def __init__(self, index: int) -> None:
        self.index = index

    def __get__(self, seen: "Observations", owner: object = None) -> NDArray[np.float64]:
        return seen.rows[:, self.index]


@dataclass(frozen=True, slots=True)
class Observations:
    """One control step of N cars: each field of `Observation` is an array (N,)."""

    rows: NDArray[np.float64]
    """(N, 7): the fields of `Observation` in their order; NaN stands for None."""

    to_lane_centre = _Column(TO_LANE_CENTRE)
    angle = _Column(ANGLE)
    heading = _Column(HEADING)
    vx = _Column(VX)
    vy = _Column(VY)
    yaw_rate = _Column(YAW_RATE)
    curvature = _Column(CURVATURE)

    def __len__(self) -> int:
        return len(self.rows)

    def split(self) -> list[Observation]:
        """Return the N observations, one for each car."""
        found = []
        for row in self.rows.tolist():
            row[HEADING] = RoadClass(row[HEADING])
            row[CURVATURE:] = [None if value != value else value for value in row[CURVATURE:]]
            found.append(Observation(*row))
        return found

    @staticmethod
    def of(observation: Observation) -> "Observations":
        """Return the observations of one car: N = 1."""
        return Observations(np.array([_values(observation)], np.float64))  # NaN for None


class Controller(Protocol):
    """A lateral controller. To add one, add a file to `laws` and an entry to `registry`."""

    def update(self, observation: Observation) -> float:
        """Return the steering action in [-1, 1], left positive; called once for each control
        step."""


class BatchController(Controller, Protocol):
    """A controller that can also steer many cars in one call, which comparisons use.

    A controller object steers either one car by `update`, or the same N cars by `update_batch`.
    """

    def update(self, observation: Observation) -> float:
        return float(self.update_batch(Observations.of(observation))[0])

    def update_batch(self, observations: Observations) -> NDArray[np.float64]:
        """Return the steering actions (N,) of all cars; called once for each control step.

        The action of car k must equal the action that `update` of a separate controller for car k
        returns. A car whose drive is over keeps its last observation; its action is ignored.
        """


@dataclass(frozen=True)
class LoopConfig:
    """The properties of the control loop in which a controller will run; a controller is made for
    them."""

    dt: float
    """Duration of a control step, s."""
    noisy: bool = False
    """True if a perception estimates the state, with errors; False if the state is exact."""
    delay_s: float | None = None
    """Delay of the perceived offset and angle, s; None if it is unknown."""
