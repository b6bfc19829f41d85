"""Linear quadratic regulators: the paper's first controller, in three forms.

Each form minimises the paper's sum(x'Qx + rho delta^2) for the linear lateral model of the car,
x = (e1, e1', e2, e2'). The gains depend on the speed.

`Lqr` (`lqr`) is the controller that the paper describes: offset, heading error and their rates, no
preview of the road. Deviations from the paper:
- It is discretised at the control rate (zero-order hold) and solves the discrete Riccati equation:
  the continuous gains are bang-bang at 20 Hz and leave the road on alpine-2.
- The gains are scheduled by speed (linear interpolation on a grid); the paper has one design speed.
- One set of weights serves all tracks, with a softer set for a perceived state; the paper tunes
  five numbers for each track.

On perception `Lqr` and `LqrPreview` limit the heading error at which they return to the line to
0.15 rad. Without the limit a start at rest 2.7 m beside the line (TORCS's place on the grid of
eroad) turns the car by 0.6 rad; the shipped model answers 0.25 rad at most, and the car left the
road.

`LqrPreview` (`lqr-preview`) adds a feed-forward of the curvature just ahead: a wheel angle, and the
slip angle of a steady bend as the set point. On perception the curvature is estimated from the yaw
rate (low-pass filter, sign limited by the class of the road), which removes the steady offset in
bends. With the errors of a briefly trained network (0.25 m, 0.025 rad) it strays 1.1 m from the
centre of `town` with the paper's weights and 0.6 m with the softer ones.

`LqrPaper` (`lqr-paper`) computes what the paper's released code computes: the continuous gains, and
steer = -K x / 21. The regulator's angle is in rad but 21 is the lock in degrees, so the car steers
57 times less than the regulator demands. The rates are differences over one control step.
"""

import math
from dataclasses import replace

from controllers.interface import LoopConfig, Observation
from controllers.laws.lateral_model import LateralModel, Matrix
from controllers.laws.lqr_gains import (
    SLOWEST_M_S,
    LqrWeights,
    SpeedTable,
    continuous_gains,
    discrete_gains,
)
from controllers.laws.steering import steer_for
from controllers.perception.curvature import CurvatureEstimate

WEIGHTS_PAPER = LqrWeights(2.0, 0.2, 2.0, 0.1, 0.01)
"""The paper's weights for forza and g-track-3 (second rows of its table)."""
WEIGHTS_EXACT = LqrWeights(10.0, 0.2, 10.0, 0.1, 0.01)
"""Weights of `Lqr` on the exact state: without preview, a higher gain on the offset keeps it small
in bends (score per step on eroad: 0.9792, with the paper's weights 0.9782)."""
WEIGHTS_PERCEIVED = LqrWeights(5.0, 0.3, 5.0, 0.2, 0.3)
"""Weights for the errors of the shipped model (score per step on images of g-track-3: 0.9894 with
`Lqr`, 0.9877 with `LqrPreview`)."""
WEIGHTS_BRIEFLY_TRAINED = LqrWeights(1.0, 1.0, 5.0, 1.0, 10.0)
"""Soft weights for the errors of a model trained for minutes (score per step on images of g-track-3
with the shipped model: 0.9717)."""
APPROACH_RAD = 0.15
"""Largest heading error (rad) at which `Lqr` and `LqrPreview` return to the line on perception."""
UNLIMITED_RAD = 1e6
"""The value of `approach_rad` that sets no limit, for the exact state."""
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
    """Largest heading error (rad) at which to return to the line; no limit on the exact state."""
    return APPROACH_RAD if loop.noisy else UNLIMITED_RAD


class Lqr:
    """The paper's regulator at a control step of `dt` s; all gains are computed at the start."""

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
        # The yaw rate alone is not e2', because the road turns in a bend.
        # At the limit the terms of the offset and of the heading are equal.
        return steer_for(
            -(
                _limited(k1 * observation.to_lane_centre, k3 * self._approach_rad)
                + k2 * (observation.vy + observation.vx * math.sin(theta))
                + k3 * theta
                + k4 * self._heading_rate(theta)
            )
        )


class LqrPreview:
    """The regulator with feed-forward of the curvature, at a control step of `dt` s."""

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
