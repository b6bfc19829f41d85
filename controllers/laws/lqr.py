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

On a perceived state, `Lqr` and `LqrPreview` limit the heading error at which they return to the
line to 0.15 rad. Without the limit a start at rest 2.7 m beside the line (TORCS's starting position
on eroad) turns the car by 0.6 rad. In such drives the model `default` answered no angle above 0.25
rad, and the car left the road.

`LqrPreview` (`lqr-preview`) adds a feed-forward of the curvature just ahead: a wheel angle, and the
slip angle of a steady bend as the set point. If the curvature is not measured, it is estimated from
the yaw rate (low-pass filter, sign limited by the class of the road), which removes the steady
offset in bends. With the errors of a briefly trained network (0.25 m, 0.025 rad) the car strays
1.1 m from the centre of `town` with the paper's weights, and 0.6 m with the softer weights.

`LqrPaper` (`lqr-paper`) computes what the paper's released code computes: the continuous gains, and
steer = -K x / 21. The regulator's angle is in rad but 21 is the lock in degrees, so the car steers
57 times less than the regulator demands. The rates are differences over one control step.
"""

import math
from dataclasses import replace

import numpy as np

from controllers.interface import (
    ANGLE,
    CURVATURE,
    HEADING,
    TO_LANE_CENTRE,
    VX,
    VY,
    YAW_RATE,
    BatchController,
    LoopConfig,
    Observations,
)
from controllers.laws.lateral_model import LateralModel, Matrix
from controllers.laws.lqr_gains import (
    SLOWEST_M_S,
    LqrWeights,
    continuous_gains,
    discrete_gains,
    row_at,
    speed_table,
)
from controllers.laws.steering import steer_for
from controllers.perception.curvature import next_curvature
from runtime.jit import compiled, compiled_for_threads

WEIGHTS_PAPER = LqrWeights(2.0, 0.2, 2.0, 0.1, 0.01)
"""The paper's LQR weights for the tracks forza and g-track-3 (second rows of the paper's table of
weights)."""
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
"""Largest heading error (rad) with which `Lqr` and `LqrPreview` drive back to the line on
perception."""
UNLIMITED_RAD = 1e6
"""The value of `approach_rad` that sets no limit, for the exact state."""
LOCK_DEG = 21.0
RATE = 3
"""Number of values in the memory of `next_rate`: 1 after the first value, else 0; the last value;
and the rate."""


def make_lqr(loop: LoopConfig, **weights: float) -> "Lqr":
    """Make an `Lqr` for a control loop; `weights` replace fields of its `LqrWeights`."""
    chosen, filter_s = (WEIGHTS_PERCEIVED, 0.2) if loop.noisy else (WEIGHTS_EXACT, 0.0)
    return Lqr(
        loop.dt,
        replace(chosen, **weights),
        rate_filter_s=filter_s,
        approach_rad=approach_limit(loop),
    )


def make_lqr_preview(loop: LoopConfig, **weights: float) -> "LqrPreview":
    """Make an `LqrPreview` for a control loop; `weights` replace fields of its `LqrWeights`."""
    chosen = WEIGHTS_PERCEIVED if loop.noisy else WEIGHTS_PAPER
    return LqrPreview(loop.dt, replace(chosen, **weights), approach_rad=approach_limit(loop))


def make_lqr_paper(loop: LoopConfig, **weights: float) -> "LqrPaper":
    """Make an `LqrPaper` for a control loop; `weights` replace fields of its `LqrWeights`."""
    return LqrPaper(loop.dt, replace(WEIGHTS_PAPER, **weights))


def approach_limit(loop: LoopConfig) -> float:
    """Return the largest heading error (rad) at which a regulator drives the car back to the line:
    0.15 on a perceived state, and no limit (1e6) on the exact state."""
    return APPROACH_RAD if loop.noisy else UNLIMITED_RAD


class Lqr(BatchController):
    """The paper's regulator at a control step of `dt` s. All gains are computed when the object is
    made."""

    def __init__(
        self,
        dt: float = 0.05,
        weights: LqrWeights = WEIGHTS_EXACT,
        *,
        rate_filter_s: float = 0.0,
        approach_rad: float = UNLIMITED_RAD,
    ) -> None:
        self.dt = dt
        self._gains = discrete_gains(weights, dt)
        self._blend = blend_for(dt, rate_filter_s)
        self._approach_rad = approach_rad
        self._rates = np.zeros((0, RATE))

    def update_batch(self, observations: Observations) -> Matrix:
        if len(self._rates) != len(observations):
            self._rates = np.zeros((len(observations), RATE))
        return regulate(
            *(observations.rows, self._gains, self._rates),
            *(self.dt, self._blend, self._approach_rad),
        )


class LqrPreview(BatchController):
    """The paper's regulator with a feed-forward of the road's curvature, at a control step of `dt`
    s."""

    def __init__(
        self,
        dt: float = 0.05,
        weights: LqrWeights = WEIGHTS_PAPER,
        *,
        curvature_filter_s: float = 0.4,
        approach_rad: float = UNLIMITED_RAD,
    ) -> None:
        self.dt = dt
        self._gains = discrete_gains(weights, dt)
        self._steady_bends = speed_table(LateralModel().cornering)
        self._filter_s = curvature_filter_s
        self._approach_rad = approach_rad
        self._curvatures = np.zeros(0)

    def update_batch(self, observations: Observations) -> Matrix:
        if len(self._curvatures) != len(observations):
            self._curvatures = np.zeros(len(observations))
        return regulate_with_preview(
            *(observations.rows, self._gains, self._steady_bends, self._curvatures),
            *(self.dt, self._filter_s, self._approach_rad),
        )


class LqrPaper(BatchController):
    """The regulator of the paper's released code. It steers 57 times less than its gains demand,
    because the code divides an angle in rad by the steering lock in degrees."""

    def __init__(
        self,
        dt: float = 0.05,
        weights: LqrWeights = WEIGHTS_PAPER,
    ) -> None:
        self.dt = dt
        self._gains = continuous_gains(weights)
        self._rates = np.zeros((0, 2, RATE))

    def update_batch(self, observations: Observations) -> Matrix:
        if len(self._rates) != len(observations):
            self._rates = np.zeros((len(observations), 2, RATE))
        return regulate_as_released(observations.rows, self._gains, self._rates, self.dt)


# In the compiled laws `seen` is `Observations.rows` (N, OBSERVED), and `gains` is the result of
# `speed_table`.


@compiled_for_threads
def regulate(
    seen: Matrix, gains: Matrix, rates: Matrix, dt: float, blend: float, approach_rad: float
) -> Matrix:
    """Return the steering actions (N,) of `Lqr` for `seen` (N, 7), the rows of `Observations`.

    `gains` (22, 4) is the result of `discrete_gains`. `rates` (N, 3) has the memory of `next_rate`
    for each car's heading error and is updated in place; `blend` is the weight of its filter.
    `approach_rad` limits the heading error (rad) at which the car returns to the line.
    """
    steers = np.empty(len(seen))
    for k in range(len(seen)):
        vx, theta = seen[k, VX], -seen[k, ANGLE]
        gain = row_at(gains, vx)
        # e2' is the rate of theta, not the yaw rate, because the road turns in a bend.
        # The limit of the offset's term is the heading's term at theta = `approach_rad`.
        steers[k] = steer_for(
            -(
                limited(gain[0] * seen[k, TO_LANE_CENTRE], gain[2] * approach_rad)
                + gain[1] * (seen[k, VY] + vx * math.sin(theta))
                + gain[2] * theta
                + gain[3] * next_rate(rates[k], theta, dt, blend)
            )
        )
    return steers


@compiled_for_threads
def regulate_with_preview(
    seen: Matrix,
    gains: Matrix,
    steady_bends: Matrix,
    curvatures: Matrix,
    dt: float,
    filter_s: float,
    approach_rad: float,
) -> Matrix:
    """Return the steering actions (N,) of `LqrPreview` for `seen` (N, 7), the rows of
    `Observations`.

    `gains` (22, 4) and `steady_bends` (22, 2) are tables of `discrete_gains` and
    `LateralModel.cornering` over the speed. `curvatures` (N,), the estimates (1/m) for cars without
    a measured curvature, are updated in place and filtered with the time constant `filter_s` (s).
    `approach_rad` limits the heading error (rad) at which the car returns to the line.
    """
    steers = np.empty(len(seen))
    for k in range(len(seen)):
        vx, theta, yaw_rate = seen[k, VX], -seen[k, ANGLE], seen[k, YAW_RATE]
        curvature = seen[k, CURVATURE]
        if math.isnan(curvature):
            curvatures[k] = next_curvature(
                curvatures[k], yaw_rate, vx, seen[k, HEADING], dt, filter_s
            )
            curvature = curvatures[k]
        speed = max(vx, SLOWEST_M_S)
        bend, gain = row_at(steady_bends, speed), row_at(gains, speed)
        steers[k] = steer_for(
            bend[0] * curvature
            - limited(gain[0] * seen[k, TO_LANE_CENTRE], gain[2] * approach_rad)
            - gain[1] * (seen[k, VY] + vx * math.sin(theta))
            - gain[2] * (theta - bend[1] * curvature)
            - gain[3] * (yaw_rate - vx * curvature)
        )
    return steers


@compiled_for_threads
def regulate_as_released(seen: Matrix, gains: Matrix, rates: Matrix, dt: float) -> Matrix:
    """Return the steering actions (N,) of `LqrPaper` for `seen` (N, 7), the rows of `Observations`.

    `gains` (22, 4) is the result of `continuous_gains`. `rates` (N, 2, 3), the memories of
    `next_rate` for offset and heading error, are updated in place.
    """
    steers = np.empty(len(seen))
    for k in range(len(seen)):
        offset, theta = seen[k, TO_LANE_CENTRE], -seen[k, ANGLE]
        gain = row_at(gains, seen[k, VX])
        demand = gain[0] * offset + gain[1] * next_rate(rates[k, 0], offset, dt, 1.0)
        demand += gain[2] * theta + gain[3] * next_rate(rates[k, 1], theta, dt, 1.0)
        steers[k] = max(-1.0, min(-demand / LOCK_DEG, 1.0))
    return steers


@compiled
def limited(value: float, limit: float) -> float:
    return max(-limit, min(value, limit))


def blend_for(dt: float, filter_s: float) -> float:
    """Return the weight (0 to 1) of a new value in a low-pass filter with the time constant
    `filter_s`, at steps of `dt`; both in s."""
    return dt / (dt + filter_s)


@compiled
def next_rate(memory: Matrix, value: float, dt: float, blend: float) -> float:
    """Return the rate of change of `value`, its difference over a control step of `dt` s, low-pass
    filtered with the weight `blend`.

    The rate of the first value is 0. `memory` (3,), which is updated in place, has 1 after the
    first value (else 0), the last value, and the rate.
    """
    if memory[0] != 0.0:
        memory[2] += blend * ((value - memory[1]) / dt - memory[2])
    memory[0], memory[1] = 1.0, value
    return float(memory[2])
