"""LQR and MPC on an estimated state: for a perception with noise, delay, or both.

Both act on the state that `controllers.laws.kalman` estimates: the offset and heading error of now,
lateral speed and yaw rate without their noise, and the curvature of the road. The paper's
controllers act on what is perceived as it is; with 5 cm of noise they steer to and fro, with a
delay of 0.1 s they oscillate.

`LqrKalman` (`lqr-kalman`) minimises the paper's cost plus `wheel_rate` times the squared change of
the wheel angle in a control step; the wheel angle is a fifth state. The wheel angle and heading of
a steady bend are its set point, as in `LqrPreview`. Until the delay is known, given by the loop or
estimated, it uses gains that stay stable with any delay up to 0.2 s.

`MpcKalman` (`mpc-kalman`) is `Mpc` on this state, with an arc of the estimated curvature as
reference.
"""

import math
from dataclasses import replace

import numpy as np
from scipy.linalg import solve_discrete_are

from controllers.interface import LoopConfig, Observation
from controllers.laws.kalman import CAR, StateEstimate
from controllers.laws.lateral_model import Matrix
from controllers.laws.lqr_gains import SLOWEST_M_S, LqrWeights, SpeedTable
from controllers.laws.mpc import Mpc, MpcWeights
from controllers.laws.steering import STEERING_LOCK, steer_for

APPROACH_RAD = 0.3
"""Largest heading error at which to return to the line."""


WEIGHTS, WHEEL_RATE = LqrWeights(10.0, 0.2, 10.0, 0.1, 0.01), 3.0
"""The paper's cost, and the weight of the squared change of the wheel angle in a control step."""
WEIGHTS_UNKNOWN_DELAY, WHEEL_RATE_UNKNOWN_DELAY = LqrWeights(1.0, 1.0, 5.0, 1.0, 10.0), 0.3
"""The cost and the weight that are used until the delay is known."""
MPC_WEIGHTS = MpcWeights(1.0, 3.0, 0.3)


def make_lqr_kalman(
    loop: LoopConfig, *, wheel_rate: float = WHEEL_RATE, **weights: float
) -> "LqrKalman":
    """`LqrKalman` for a control loop; `weights` replace fields of its `LqrWeights`."""
    return LqrKalman(loop.dt, replace(WEIGHTS, **weights), wheel_rate, loop.delay_s)


def make_mpc_kalman(loop: LoopConfig, **weights: float) -> "MpcKalman":
    """`MpcKalman` for a control loop; `weights` replace fields of its `MpcWeights`."""
    return MpcKalman(loop.dt, replace(MPC_WEIGHTS, **weights), loop.delay_s)


class LqrKalman:
    """Linear quadratic regulator on the estimated state at a control step of `dt` s.

    `delay_s`: the delay of the perception, if it is known; otherwise it is estimated.
    """

    def __init__(
        self,
        dt: float = 0.05,
        weights: LqrWeights = WEIGHTS,
        wheel_rate: float = WHEEL_RATE,
        delay_s: float | None = None,
    ) -> None:
        self.estimate = StateEstimate(dt, delay_s)
        self.wheel_angle = 0.0
        """rad of the front wheels since the last control step."""
        self._gains = SpeedTable(lambda speed: smooth_gain(weights, wheel_rate, speed, dt))
        self._cautious = SpeedTable(
            lambda speed: smooth_gain(WEIGHTS_UNKNOWN_DELAY, WHEEL_RATE_UNKNOWN_DELAY, speed, dt)
        )
        self._steady_bends = SpeedTable(CAR.cornering)

    def update(self, observation: Observation) -> float:
        state = self.estimate.update(observation, self.wheel_angle)
        offset, theta, vy, yaw_rate, curvature = state.tolist()
        speed = max(self.estimate.speed, SLOWEST_M_S)
        gains = self._gains if self.estimate.delay.is_known else self._cautious
        k1, k2, k3, k4, k5 = gains(speed).tolist()
        wheel_per_bend, theta_per_bend = self._steady_bends(speed).tolist()
        limit = k3 * APPROACH_RAD
        change = -(
            max(-limit, min(k1 * offset, limit))
            + k2 * (vy + speed * math.sin(theta))
            + k3 * (theta - theta_per_bend * curvature)
            + k4 * (yaw_rate - speed * curvature)
            + k5 * (self.wheel_angle - wheel_per_bend * curvature)
        )
        self.wheel_angle = max(-STEERING_LOCK, min(self.wheel_angle + change, STEERING_LOCK))
        return steer_for(self.wheel_angle)


class MpcKalman:
    """Model predictive control on the estimated state at a control step of `dt` s.

    `delay_s`: the delay of the perception, if it is known; otherwise it is estimated.
    """

    def __init__(
        self,
        dt: float = 0.05,
        weights: MpcWeights = MPC_WEIGHTS,
        delay_s: float | None = None,
    ) -> None:
        self.estimate = StateEstimate(dt, delay_s)
        self._mpc = Mpc(dt, weights, preview=True)
        self._steer = 0.0

    def update(self, observation: Observation) -> float:
        state = self.estimate.update(observation, self._steer * STEERING_LOCK)
        offset, theta, vy, yaw_rate, curvature = state.tolist()
        known = replace(
            observation,
            to_lane_centre=offset,
            angle=-theta,
            vx=self.estimate.speed,
            vy=vy,
            yaw_rate=yaw_rate,
            curvature=curvature,
        )
        self._steer = self._mpc.update(known)
        return self._steer


def smooth_gain(weights: LqrWeights, wheel_rate: float, speed: float, dt: float) -> Matrix:
    """The gain K (5,) of change = -K (e1, e1', e2, e2', wheel angle), all minus their set points.

    The change of the wheel angle, in rad, is that of one control step of `dt` s at `speed` m/s.
    """
    A, B = CAR.discretise(speed, dt)
    states = np.block([[A, B], [np.zeros((1, 4)), np.eye(1)]])
    change = np.vstack([B, [[1.0]]])
    Q = np.diag([*np.diag(weights.Q), weights.rho])
    # The wheels are held at their new angle: rho (wheel + change)^2 has a mixed term.
    mixed = np.array([[0.0], [0.0], [0.0], [0.0], [weights.rho]])
    R = np.array([[weights.rho + wheel_rate]])
    P = solve_discrete_are(states, change, Q, R, s=mixed)
    gain: Matrix = np.linalg.solve(R + change.T @ P @ change, change.T @ P @ states + mixed.T)[0]
    return gain
