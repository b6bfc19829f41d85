"""LQR and MPC on an estimated state: for a perception with noise, delay, or both.

Both controllers act on the state that `controllers.laws.kalman` estimates: the present offset and
heading error, lateral speed and yaw rate without their noise, and the curvature of the road. The
paper's controllers use the perceived values unchanged: with noise of 5 cm (standard deviation) they
steer to and fro, and with a delay of 0.1 s they oscillate.

`LqrKalman` (`lqr-kalman`) minimises the paper's cost plus `wheel_rate` times the squared change of
the wheel angle in a control step; the wheel angle is a fifth state. The wheel angle and heading of
a steady bend are its set point, as in `LqrPreview`. Until the delay is known, given by the loop or
estimated, it uses gains that stay stable with any delay up to 0.2 s.

`MpcKalman` (`mpc-kalman`) is `Mpc` on this state, with an arc of the estimated curvature as
reference.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import solve_discrete_are

from controllers.interface import (
    ANGLE,
    CURVATURE,
    TO_LANE_CENTRE,
    VX,
    VY,
    YAW_RATE,
    BatchController,
    LoopConfig,
    Observations,
)
from controllers.laws.kalman import CAR, KAPPA, THETA, E, R, StateEstimate, V
from controllers.laws.lateral_model import Matrix
from controllers.laws.lqr import limited
from controllers.laws.lqr_gains import SLOWEST_M_S, LqrWeights, row_at, speed_table
from controllers.laws.mpc import Mpc, MpcWeights
from controllers.laws.steering import STEERING_LOCK, steer_for
from runtime.jit import compiled_for_threads

APPROACH_RAD = 0.3
"""Largest heading error (rad) with which `LqrKalman` drives the car back to the line."""


WEIGHTS, WHEEL_RATE = LqrWeights(10.0, 0.2, 10.0, 0.1, 0.01), 3.0
"""Weights of the paper's cost and of the squared change of the wheel angle in a control step."""
WEIGHTS_UNKNOWN_DELAY, WHEEL_RATE_UNKNOWN_DELAY = LqrWeights(1.0, 1.0, 5.0, 1.0, 10.0), 0.3
"""Weights of the same two terms, used until the delay is known."""
MPC_WEIGHTS = MpcWeights(1.0, 3.0, 0.3)


def make_lqr_kalman(
    loop: LoopConfig, *, wheel_rate: float = WHEEL_RATE, **weights: float
) -> "LqrKalman":
    """Make an `LqrKalman` for a control loop. `wheel_rate` is the weight of the squared change of
    the wheel angle in a control step; `weights` replace fields of its `LqrWeights`."""
    return LqrKalman(loop.dt, replace(WEIGHTS, **weights), wheel_rate, loop.delay_s)


def make_mpc_kalman(loop: LoopConfig, **weights: float) -> "MpcKalman":
    """Make an `MpcKalman` for a control loop; `weights` replace fields of its `MpcWeights`."""
    return MpcKalman(loop.dt, replace(MPC_WEIGHTS, **weights), loop.delay_s)


class LqrKalman(BatchController):
    """Linear quadratic regulator on the estimated state at a control step of `dt` s.

    `delay_s`: the delay of the perception, s; None if it must be estimated.
    """

    def __init__(
        self,
        dt: float = 0.05,
        weights: LqrWeights = WEIGHTS,
        wheel_rate: float = WHEEL_RATE,
        delay_s: float | None = None,
    ) -> None:
        self.estimate = StateEstimate(dt, delay_s)
        self.wheel_angles: Matrix = np.zeros(0)
        """Angle (rad) of the front wheels of each car since the last control step."""
        self._gains = speed_table(lambda speed: smooth_gain(weights, wheel_rate, speed, dt))
        self._cautious = speed_table(
            lambda speed: smooth_gain(WEIGHTS_UNKNOWN_DELAY, WHEEL_RATE_UNKNOWN_DELAY, speed, dt)
        )
        self._steady_bends = speed_table(CAR.cornering)

    def update_batch(self, observations: Observations) -> Matrix:
        if len(self.wheel_angles) != len(observations):
            self.wheel_angles = np.zeros(len(observations))
        states = self.estimate.update(observations, self.wheel_angles)
        return regulate_smoothly(
            *(self.estimate.speeds, states, self.estimate.delays, self.wheel_angles),
            *(self._gains, self._cautious, self._steady_bends),
        )


class MpcKalman(BatchController):
    """Model predictive control on the estimated state at a control step of `dt` s.

    `delay_s`: the delay of the perception, s; None if it must be estimated.
    """

    def __init__(
        self,
        dt: float = 0.05,
        weights: MpcWeights = MPC_WEIGHTS,
        delay_s: float | None = None,
    ) -> None:
        self.estimate = StateEstimate(dt, delay_s)
        self._mpc = Mpc(dt, weights, preview=True)
        self._steers: Matrix = np.zeros(0)

    def update_batch(self, observations: Observations) -> Matrix:
        if len(self._steers) != len(observations):
            self._steers = np.zeros(len(observations))
        states = self.estimate.update(observations, self._steers * STEERING_LOCK)
        known = observations.rows.copy()
        known[:, [TO_LANE_CENTRE, VY, YAW_RATE, CURVATURE]] = states[:, [E, V, R, KAPPA]]
        known[:, ANGLE], known[:, VX] = -states[:, THETA], self.estimate.speeds
        self._steers = self._mpc.update_batch(Observations(known))
        return self._steers


@compiled_for_threads
def regulate_smoothly(
    speeds: Matrix,
    states: Matrix,
    delays: Any,
    wheel_angles: Matrix,
    gains: Matrix,
    cautious: Matrix,
    steady_bends: Matrix,
) -> Matrix:
    """Return the steering actions (N,) of `LqrKalman`; `wheel_angles` (N,), rad, are updated in
    place.

    `speeds` (N,) are in m/s, `states` (N, 5) the estimated states, `delays` (N,) of the type
    DELAY_MEMORY. The tables over the speed are made by `speed_table`: `gains` and `cautious` (22,
    5) have the gains for a known and an unknown delay, `steady_bends` (22, 2) the results of
    `LateralModel.cornering`.
    """
    steers = np.empty(len(states))
    for k in range(len(states)):
        offset, theta, curvature = states[k, E], states[k, THETA], states[k, KAPPA]
        speed = max(speeds[k], SLOWEST_M_S)
        gain = row_at(gains if delays[k].is_known else cautious, speed)
        bend = row_at(steady_bends, speed)
        change = -(
            limited(gain[0] * offset, gain[2] * APPROACH_RAD)
            + gain[1] * (states[k, V] + speed * math.sin(theta))
            + gain[2] * (theta - bend[1] * curvature)
            + gain[3] * (states[k, R] - speed * curvature)
            + gain[4] * (wheel_angles[k] - bend[0] * curvature)
        )
        wheel_angles[k] = max(-STEERING_LOCK, min(wheel_angles[k] + change, STEERING_LOCK))
        steers[k] = steer_for(wheel_angles[k])
    return steers


def smooth_gain(weights: LqrWeights, wheel_rate: float, speed: float, dt: float) -> Matrix:
    """Return the gain K (5,) of the law change = -K x.

    x is (e1, e1', e2, e2', wheel angle) minus the set points of these values. `change` is the
    change of the wheel angle (rad) over one control step of `dt` s at `speed` m/s.
    """
    A, B = CAR.discretise(speed, dt)
    states = np.block([[A, B], [np.zeros((1, 4)), np.eye(1)]])
    change = np.vstack([B, [[1.0]]])
    Q = np.diag([*np.diag(weights.Q), weights.rho])
    # The wheels have the new angle, wheel + change, during the step, so the cost
    # rho (wheel + change)^2 has a mixed term.
    mixed = np.array([[0.0], [0.0], [0.0], [0.0], [weights.rho]])
    R = np.array([[weights.rho + wheel_rate]])
    P = solve_discrete_are(states, change, Q, R, s=mixed)
    gain: Matrix = np.linalg.solve(R + change.T @ P @ change, change.T @ P @ states + mixed.T)[0]
    return gain
