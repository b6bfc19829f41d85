"""Linear quadratic regulators: the paper's first controller, in three forms.

All minimise the paper's sum(x'Qx + rho delta^2) for its linear lateral model, x = (e1, e1', e2,
e2'); their gains follow the speed.

`Lqr` (`lqr`) is what the paper states: offset, heading error and their rates, no preview of the
road. Deviations from the paper:
- discretised at the control rate (zero-order hold), then the discrete Riccati equation: the
  continuous gains are bang-bang at 20 Hz and leave the road on alpine-2;
- gains scheduled by speed (a grid, interpolated linearly) in place of one design speed;
- one set of weights for all tracks, where the paper tunes five numbers a track, and a softer set
  for a perceived state.

On perception `Lqr` and `LqrPreview` return to the line at a heading error of 0.15 rad at most. A
start at rest 2.7 m beside it (TORCS's place on the grid of eroad) otherwise turns the car by 0.6
rad; the model that ships answers 0.25 rad at most, and the car left the road.

`LqrPreview` (`lqr-preview`) also knows the curvature of the road just ahead: feed-forward of the
wheel angle, with the slip angle of a steady bend as the set point. On perception the curvature is
estimated from the yaw rate (low-pass filter, its sign limited by the heading class), which removes
the steady offset in bends. With the errors of a briefly trained network (0.25 m, 0.025 rad) it
strays 1.1 m from the centre of `town` with the paper's weights, 0.6 m with the softer ones.

`LqrPaper` (`lqr-paper`) is what the paper's released code computes: the continuous gains, and
steer = -K x / 21. The regulator's angle is in rad and 21 is the lock in degrees, so that the car
steers 57 times less than the regulator asks for. The rates are differences over one control step.
"""

import math
from dataclasses import dataclass, replace

from controllers.interface import LoopConfig, Observation
from controllers.lateral_model import (
    SLOWEST_M_S,
    LateralModel,
    LqrWeights,
    Matrix,
    SpeedTable,
    continuous_gains,
    discrete_gains,
)
from controllers.torcs_feedback import steer_for
from trackfeatures import RoadClass

WEIGHTS_PAPER = LqrWeights(2.0, 0.2, 2.0, 0.1, 0.01)
"""The paper's for forza and g-track-3 (second rows of its table)."""
WEIGHTS_EXACT = LqrWeights(10.0, 0.2, 10.0, 0.1, 0.01)
"""Of `Lqr` on the exact state: without preview a higher gain on the offset keeps it small in bends
(score a step on eroad 0.9792; 0.9782 with the paper's)."""
WEIGHTS_PERCEIVED = LqrWeights(5.0, 0.3, 5.0, 0.2, 0.3)
"""For the errors of the model that ships (g-track-3 on images: 0.9894 a step with `Lqr`, 0.9877
with `LqrPreview`)."""
WEIGHTS_BRIEFLY_TRAINED = LqrWeights(1.0, 1.0, 5.0, 1.0, 10.0)
"""Soft, for the errors of a model trained for minutes; g-track-3 on the shipped model: 0.9717."""
APPROACH_RAD = 0.15
"""Largest heading error at which `Lqr` and `LqrPreview` return to the line on perception."""
UNLIMITED_RAD = 1e6
"""`approach_rad` on the exact state: no limit."""
LOCK_DEG = 21.0


def make_lqr(loop: LoopConfig, **weights: float) -> "Lqr":
    """`Lqr` for a control loop; `weights` replace fields of its `LqrWeights`."""
    chosen, filter_s = (WEIGHTS_PERCEIVED, 0.2) if loop.noisy else (WEIGHTS_EXACT, 0.0)
    return Lqr(
        loop.dt,
        replace(chosen, **weights),
        rate_filter_s=filter_s,
        approach_rad=approach_limit(loop),
    )


def make_lqr_preview(loop: LoopConfig, **weights: float) -> "LqrPreview":
    """`LqrPreview` for a control loop; `weights` replace fields of its `LqrWeights`."""
    chosen = WEIGHTS_PERCEIVED if loop.noisy else WEIGHTS_PAPER
    return LqrPreview(loop.dt, replace(chosen, **weights), approach_rad=approach_limit(loop))


def make_lqr_paper(loop: LoopConfig, **weights: float) -> "LqrPaper":
    """`LqrPaper` for a control loop; `weights` replace fields of its `LqrWeights`."""
    return LqrPaper(loop.dt, replace(WEIGHTS_PAPER, **weights))


def approach_limit(loop: LoopConfig) -> float:
    """The largest heading error (rad) at which to return to the line: none on the exact state."""
    return APPROACH_RAD if loop.noisy else UNLIMITED_RAD


class Lqr:
    """The paper's regulator at a control step of `dt` s; all gains are known from the start."""

    def __init__(
        self,
        dt: float = 0.05,
        weights: LqrWeights = WEIGHTS_EXACT,
        model: LateralModel | None = None,
        *,
        rate_filter_s: float = 0.0,
        approach_rad: float = UNLIMITED_RAD,
    ) -> None:
        self.dt, self.weights, self.model = dt, weights, model or LateralModel()
        self._gains = discrete_gains(self.model, weights, dt)
        self._heading_rate = RateEstimate(dt, rate_filter_s)
        self._approach_rad = approach_rad

    def gain(self, speed: float) -> Matrix:
        """K (4,) at `speed` m/s."""
        return self._gains(speed)

    def update(self, observation: Observation) -> float:
        theta = -observation.angle
        k1, k2, k3, k4 = self._gains(observation.vx).tolist()
        # The yaw rate alone is not e2': in a bend the road turns, too.
        # At the limit the parts of the offset and of the heading are equal.
        return steer_for(
            -(
                _limited(k1 * observation.to_lane_centre, k3 * self._approach_rad)
                + k2 * (observation.vy + observation.vx * math.sin(theta))
                + k3 * theta
                + k4 * self._heading_rate(theta)
            )
        )


class LqrPreview:
    """Speed-scheduled LQR with feed-forward of the curvature at a control step of `dt` s."""

    def __init__(
        self,
        dt: float = 0.05,
        weights: LqrWeights = WEIGHTS_PAPER,
        model: LateralModel | None = None,
        *,
        curvature_filter_s: float = 0.4,
        approach_rad: float = UNLIMITED_RAD,
    ) -> None:
        self.dt, self.weights, self.model = dt, weights, model or LateralModel()
        self._gains = discrete_gains(self.model, weights, dt)
        self._steady_bends = SpeedTable(self.model.cornering)
        self._estimate = CurvatureEstimate(dt, curvature_filter_s)
        self._approach_rad = approach_rad

    def gain(self, speed: float) -> Matrix:
        """K (4,) at `speed` m/s."""
        return self._gains(speed)

    def update(self, observation: Observation) -> float:
        speed = max(observation.vx, SLOWEST_M_S)
        curvature = observation.curvature
        if curvature is None:
            curvature = self._estimate(observation)
        theta = -observation.angle
        wheel_per_bend, theta_per_bend = self._steady_bends(speed).tolist()
        k1, k2, k3, k4 = self._gains(speed).tolist()
        return steer_for(
            wheel_per_bend * curvature
            - _limited(k1 * observation.to_lane_centre, k3 * self._approach_rad)
            - k2 * (observation.vy + observation.vx * math.sin(theta))
            - k3 * (theta - theta_per_bend * curvature)
            - k4 * (observation.yaw_rate - observation.vx * curvature)
        )


class LqrPaper:
    """The regulator as the paper's released code runs it."""

    def __init__(
        self,
        dt: float = 0.05,
        weights: LqrWeights = WEIGHTS_PAPER,
        model: LateralModel | None = None,
    ) -> None:
        self.weights, self.model = weights, model or LateralModel()
        self._gains = continuous_gains(self.model, weights)
        self._offset_rate, self._heading_rate = RateEstimate(dt), RateEstimate(dt)

    def update(self, observation: Observation) -> float:
        offset, theta = observation.to_lane_centre, -observation.angle
        k1, k2, k3, k4 = self._gains(observation.vx).tolist()
        demand = k1 * offset + k2 * self._offset_rate(offset)
        demand += k3 * theta + k4 * self._heading_rate(theta)
        return float(max(-1.0, min(-demand / LOCK_DEG, 1.0)))


def _limited(value: float, limit: float) -> float:
    return max(-limit, min(value, limit))


class RateEstimate:
    """The rate of a quantity from its differences over a control step, low-pass filtered."""

    def __init__(self, dt: float, filter_s: float = 0.0) -> None:
        self._dt = dt
        self._blend = dt / (dt + filter_s)
        self._last: float | None = None
        self._rate = 0.0

    def __call__(self, value: float) -> float:
        """The rate now; 0 at the first call."""
        if self._last is not None:
            self._rate += self._blend * ((value - self._last) / self._dt - self._rate)
        self._last = value
        return self._rate


@dataclass
class CurvatureEstimate:
    """The road's curvature (1/m) from the car's yaw rate and speed, low-pass filtered."""

    dt: float
    filter_s: float = 0.4
    value: float = 0.0

    def __call__(self, observation: Observation) -> float:
        """The estimate after this step; its sign does not contradict the heading class."""
        turning = observation.yaw_rate / max(observation.vx, SLOWEST_M_S)
        self.value += self.dt / (self.dt + self.filter_s) * (turning - self.value)
        if observation.heading is RoadClass.LEFT:
            self.value = max(self.value, 0.0)
        elif observation.heading is RoadClass.RIGHT:
            self.value = min(self.value, 0.0)
        return self.value
