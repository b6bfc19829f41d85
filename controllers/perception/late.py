"""Perception with latency and lost answers; the state is predicted until an answer arrives. SI
units.

An answer describes the moment of its image. The car moves on until the answer arrives, so the
offset d and the angle are predicted to the present from the car's own speeds and yaw rate:

    d' = vx sin(theta) + vy cos(theta), theta' = yaw rate - curvature * vx   (theta = -angle)
"""

import itertools
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from controllers.interface import Observation
from controllers.perception.curvature import CurvatureEstimate
from controllers.perception.perceived import Perceived
from controllers.perception.trust import Trust
from simulator.vehicle.state import CarState
from trackfeatures import RoadClass
from trackfeatures.errors import UserError

World = TypeVar("World")

LOST_S = 1.0
"""Time (s) without an answer after which nothing is predicted: the perception is lost."""


@dataclass(frozen=True, slots=True)
class _Moment:
    """One control step: the car's own sensors and the estimate of the road's curvature."""

    vx: float
    vy: float
    yaw_rate: float
    curvature: float


class StatePredictor:
    """Predicts an answer from the moment of its image to the present, over at most `longest_s` s.

    Call `add` once for each control step of `dt` s.
    """

    def __init__(self, dt: float, longest_s: float) -> None:
        self._dt = dt
        self._moments: deque[_Moment] = deque(maxlen=round(longest_s / dt) + 2)
        self._curvature = CurvatureEstimate(dt)

    def add(self, now: CarState, heading: RoadClass) -> None:
        """Store the car's motion at this step; `heading` is the last known class of the road."""
        seen = Observation(0.0, 0.0, heading, now.vx, now.vy, now.yaw_rate)
        self._moments.append(_Moment(now.vx, now.vy, now.yaw_rate, self._curvature(seen)))

    def reaches(self, age: int) -> bool:
        """Whether the motion since `age` control steps ago is stored."""
        return age < len(self._moments)

    def predict(self, answer: Perceived, age: int, until: int = 0) -> Perceived:
        """Return `answer` predicted from the moment of its image, `age` control steps ago, to the
        moment `until` control steps ago."""
        if age == until or answer.to_lane_centre is None:
            return answer
        moments = list(self._moments)
        past = moments[-age - 1 : len(moments) - until]
        offset, theta = answer.to_lane_centre, -answer.angle
        for before, after in itertools.pairwise(past):
            # The mean motion in the step: the motion is measured at the step's begin and end.
            vx, vy = 0.5 * (before.vx + after.vx), 0.5 * (before.vy + after.vy)
            curvature = before.curvature if answer.curvature is None else answer.curvature
            turn = 0.5 * (before.yaw_rate + after.yaw_rate) - curvature * vx
            middle = theta + 0.5 * self._dt * turn
            offset += self._dt * (vx * math.sin(middle) + vy * math.cos(middle))
            theta += self._dt * turn
        return replace(answer, to_lane_centre=offset, angle=-theta)


class RoadEstimate:
    """Estimates the road from late and lost answers: `Trust` fuses the received answers, and the
    result is predicted to the present.

    Call `update` once for each control step, then `present`. With `predict=False` the estimate is
    the newest answer, unchanged.
    """

    def __init__(self, dt: float, latency_s: float = 0.0, *, predict: bool = True) -> None:
        self.dt = dt
        self._predictor = StatePredictor(dt, LOST_S + latency_s) if predict else None
        self._trust = Trust()
        self._last: Perceived | None = None
        self._age = 0
        """Control steps since the image of `_last`."""
        self._heading = RoadClass.STRAIGHT

    def update(self, now: CarState, arrived: Perceived | None, age: int) -> None:
        """Advance by one control step. `arrived` is the answer to the image of `age` control steps
        ago; None if no answer arrived in this step."""
        self._age += 1
        if arrived is not None:
            self._heading = arrived.heading
        if self._predictor is not None:
            self._predictor.add(now, self._heading)
        if arrived is not None:
            self._last, self._age = self._corrected(arrived, age, now.vx), age

    def _corrected(self, arrived: Perceived, age: int, speed: float) -> Perceived:
        if self._predictor is None:
            return arrived
        steps, known = self._age - age, None
        reached = self._predictor.reaches(self._age)
        if self._last is not None and steps * self.dt <= LOST_S and reached:
            known = self._predictor.predict(self._last, self._age, until=age)
        return self._trust.correct(known, arrived, steps, steps * self.dt * speed)

    def present(self, due: int) -> Perceived:
        """Return the estimate of the road at this control step.

        An answer is due `due` steps after its image. `lost_s` of the result is the time (s) for
        which no answer arrived when it was due, or the answers had little weight in the estimate.
        """
        waited_s = max(self._age - due, 0) * self.dt
        if self._last is None or waited_s > LOST_S:
            return Perceived(None, 0.0, self._heading, None, lost_s=waited_s)
        if self._predictor is None:
            return replace(self._last, lost_s=waited_s)
        lost_s = waited_s + self._trust.untrusted_steps * self.dt
        return replace(self._predictor.predict(self._last, self._age), lost_s=lost_s)


class TrustedPerception(Generic[World]):
    """A perception without latency. The answers of the given perception are fused with the state
    estimate.

    Answers without a standard deviation or without an offset are returned unchanged.
    """

    def __init__(
        self,
        perceive: Callable[[World], Perceived],
        state: Callable[[World], CarState],
        *,
        dt: float,
    ) -> None:
        self._perceive, self._state = perceive, state
        self._estimate = RoadEstimate(dt)

    def __call__(self, world: World) -> Perceived:
        """Return the estimate of the road at this control step, for the controller."""
        answer = self._perceive(world)
        blind = answer.to_lane_centre is None
        self._estimate.update(self._state(world), None if blind else answer, 0)
        return answer if blind or answer.offset_std_m is None else self._estimate.present(0)


def check_drop(drop: float) -> None:
    """Raise UserError unless `drop`, the share of lost answers, is at least 0 and below 1."""
    if not 0.0 <= drop < 1.0:
        raise UserError(f"a share of {drop} lost answers; give 0 or more, below 1")


def delay_steps(latency_s: float, dt: float) -> int:
    """Return a latency in control steps of `dt` s, rounded up. Raises UserError for a latency below
    0 or above 1 s."""
    if not 0.0 <= latency_s <= LOST_S:
        raise UserError(f"a latency of {1000 * latency_s:g} ms; give 0 to 1000 ms")
    return math.ceil(latency_s / dt - 1e-9)


class LatePerception(Generic[World]):
    """A perception whose answers arrive `latency_s` late; a share `drop` of them is lost.

    The latency is rounded up to control steps, because a controller uses an answer at its next
    step. `predict=False` returns the late answers without prediction. Raises UserError for a
    latency outside 0 to 1 s, and for a share that is negative or at least 1.
    """

    def __init__(
        self,
        perceive: Callable[[World], Perceived],
        state: Callable[[World], CarState],
        *,
        dt: float,
        latency_s: float,
        drop: float,
        rng: np.random.Generator,
        predict: bool = True,
    ) -> None:
        check_drop(drop)
        self._perceive, self._state = perceive, state
        self._delay = delay_steps(latency_s, dt)
        self._drop, self._rng = drop, rng
        self._estimate = RoadEstimate(dt, latency_s, predict=predict)
        self._under_way: deque[Perceived | None] = deque()
        self.lost_answers = 0

    def __call__(self, world: World) -> Perceived:
        """Return the estimate of the road at this control step, for the controller."""
        lost = self._rng.random() < self._drop
        answer = self._perceive(world)
        self.lost_answers += lost
        self._under_way.append(None if lost or answer.to_lane_centre is None else answer)
        arrived = self._under_way.popleft() if len(self._under_way) > self._delay else None
        self._estimate.update(self._state(world), arrived, self._delay)
        return self._estimate.present(self._delay)
