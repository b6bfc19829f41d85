"""The car's state relative to the road, estimated from noisy and late measurements. SI units.

A Kalman filter of the linear single-track model (Rajamani, "Vehicle Dynamics and Control", 2.2) on
(e, theta, vy, r, kappa): offset from the line (m, left positive), heading error (rad,
counter-clockwise), lateral speed (m/s), yaw rate (rad/s) and the curvature of the road (1/m), which
is a random walk.

A perception measures e and theta, possibly late; the car measures vy and r at once. The filter
estimates the state at the moment of the image, and predicts it to the present with the car's
measurements and the steering of the steps between (the Smith predictor of a known delay). The delay
is estimated (`controllers.laws.delay`). The variance of the measurements' noise is estimated from
their third differences, in which motion nearly cancels and noise does not.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from controllers.interface import Observation
from controllers.laws.delay import MAX_DELAY, DelayEstimate
from controllers.laws.lateral_model import LateralModel
from controllers.laws.lqr_gains import FASTEST_M_S, GRID_M_S, SLOWEST_M_S
from runtime.jit import compiled

Vector = NDArray[np.float64]

E, THETA, VY, R, KAPPA = range(5)
STATES, MEASURED = 5, 4
CAR = LateralModel(
    mass=1230.0, yaw_inertia=1120.0, front_stiffness=125_000.0, rear_stiffness=125_000.0
)
"""The car with its fuel; yaw inertia and tyre stiffness as the recorded TORCS laps show them
(`simulator.vehicle.car`), not the paper's values."""
PROCESS_STD = np.array([0.003, 0.0007, 0.02, 0.02, 0.0005])
"""Standard deviations of the model's error in a control step, at `USUAL_M_S` and above."""
USUAL_M_S, SLOWEST_SHARE = 15.0, 0.1
"""Below this speed the standard deviations fall in proportion to it, to a tenth at least: the state
of a slow car changes less in a control step."""
START_STD = np.array([0.1, 0.05, 0.1, 0.1, 0.02])
LEAST_STD = np.array([1e-3, 2e-4, 1e-2, 1e-3])
MOST_STD = np.array([0.2, 0.02, 0.12, 0.012])
"""Limits of the measurements' standard deviations (e, theta, vy, r): the filter always trusts a
sensor a little, and a car that oscillates does not count as a bad sensor."""
NOISE_STEPS = 100
"""Control steps over which the variance of the noise is averaged."""
THIRD_DIFFERENCE = 20.0
"""Variance of a third difference of white noise: 1 + 9 + 9 + 1 times that of the noise."""


class StateEstimate:
    """Estimates the state of each control step of `dt` s; `delay_s`: the delay, if it is known."""

    def __init__(self, dt: float, delay_s: float | None = None) -> None:
        self.delay = DelayEstimate(dt, delay_s)
        self.noise_variance = np.zeros(MEASURED)
        """Of (e, theta, vy, r), without limits."""
        self._table = transitions(dt)
        self._x, self._covariance = np.zeros(STATES), np.zeros((STATES, STATES))
        self._own = np.zeros((MAX_DELAY + 2, 4))  # vx, vy, yaw rate, wheel angle; newest first
        self._recent = np.zeros((4, MEASURED))
        self._steps = 0
        self._last = np.array([0.0, 0.0, SLOWEST_M_S, 0.0, 0.0])

    @property
    def speed(self) -> float:
        """vx (m/s) of the last control step."""
        return float(self._last[2])

    def update(self, observation: Observation, wheel_angle: float) -> Vector:
        """The present state (5,) from the observation of this control step.

        `wheel_angle`: angle (rad) of the front wheels since the last control step. A measurement
        that is not finite counts as unchanged, because otherwise it would stay in the filter.
        """
        seen, own = self._measurements(observation)
        self._own[1:] = self._own[:-1].copy()
        self._own[0, :3], self._own[1, 3] = own, wheel_angle
        if self._steps == 0:
            self._own[:, :3] = own
        changed = self.delay.update(seen[THETA], own[2])
        if changed or self._steps == 0:
            self._x[:VY], self._x[VY:KAPPA] = seen, self._own[self.delay.steps, 1:3]
            self._covariance[:] = np.diag(START_STD**2)
        self._note_noise(np.array([*seen, *own[1:]]))
        self._steps += 1
        share = min(max(self.speed / USUAL_M_S, SLOWEST_SHARE), 1.0)
        return advance(
            self._x,
            self._covariance,
            self._table,
            self._own,
            seen,
            self.noise_variance.clip(LEAST_STD**2, MOST_STD**2),
            (PROCESS_STD * share) ** 2,
            self.delay.steps,
        )

    def _measurements(self, observation: Observation) -> tuple[Vector, Vector]:
        """Offset and heading error (2,) of the image; vx, vy and yaw rate (3,) of the car."""
        given = np.array(
            [
                *(observation.to_lane_centre, -observation.angle),
                *(observation.vx, observation.vy, observation.yaw_rate),
            ]
        )
        self._last = np.where(np.isfinite(given), given, self._last)
        return self._last[:2], self._last[2:]

    def _note_noise(self, measured: Vector) -> None:
        self._recent[1:] = self._recent[:-1].copy()
        self._recent[0] = measured
        if self._steps < len(self._recent) - 1:
            return
        newest, second, third, oldest = self._recent
        difference = newest - 3.0 * second + 3.0 * third - oldest
        weight = 1.0 / min(self._steps - 2, NOISE_STEPS)
        self.noise_variance += weight * (difference**2 / THIRD_DIFFERENCE - self.noise_variance)


@lru_cache(maxsize=8)
def transitions(dt: float, model: LateralModel = CAR) -> Vector:
    """Exact transitions (speeds, 5, 6) from state and wheel angle (rad) over `dt` s, by speed."""
    speeds = np.arange(SLOWEST_M_S, FASTEST_M_S + GRID_M_S, GRID_M_S)
    return np.array([_transition(float(speed), dt, model) for speed in speeds])


def _transition(speed: float, dt: float, model: LateralModel) -> Vector:
    lateral, wheel, turn = model.matrices(speed)
    block = np.zeros((STATES + 1, STATES + 1))
    block[E, THETA], block[E, VY] = speed, 1.0
    block[THETA, R], block[THETA, KAPPA] = 1.0, -speed
    # The model's rates are e' = vy + vx theta and theta': the columns of e' are those of vy.
    block[VY, VY], block[VY, R] = lateral[1, 1], turn[1, 0]
    block[R, VY], block[R, R] = lateral[3, 1], lateral[3, 3]
    block[VY, STATES], block[R, STATES] = wheel[1, 0], wheel[3, 0]
    step: Vector = expm(block * dt)[:STATES]
    return step


@compiled
def advance(
    x: Vector,
    covariance: Vector,
    table: Vector,
    own: Vector,
    seen: Vector,
    variance: Vector,
    process: Vector,
    delay: int,
) -> Vector:
    """One control step of the filter; returns the present state (5,).

    `x` (5,) and `covariance` (5, 5) are the state at the moment of the image, `delay` steps ago;
    both are replaced. `own` (n, 4): vx, vy, yaw rate and wheel angle, newest first. `seen` (2,): e
    and theta of the image. `variance` (4,): of the measurements. `process` (5,): variance of the
    model's error.
    """
    predict(x, covariance, table, own[delay + 1, 0], own[delay + 1, 3], process)
    correct(x, covariance, VY, own[delay, 1], variance[VY])
    correct(x, covariance, R, own[delay, 2], variance[R])
    correct(x, covariance, THETA, seen[1], variance[THETA])
    correct(x, covariance, E, seen[0], variance[E])
    present, spread = x.copy(), covariance.copy()
    for step in range(delay - 1, -1, -1):
        predict(present, spread, table, own[step + 1, 0], own[step + 1, 3], process)
        correct(present, spread, VY, own[step, 1], variance[VY])
        correct(present, spread, R, own[step, 2], variance[R])
    return present


@compiled
def predict(
    x: Vector, covariance: Vector, table: Vector, vx: float, wheel: float, process: Vector
) -> None:
    """Replace state (5,) and covariance (5, 5) by their predictions for the next control step."""
    place = (min(max(vx, SLOWEST_M_S), FASTEST_M_S) - SLOWEST_M_S) / GRID_M_S
    low = min(int(place), len(table) - 2)
    share = place - low
    step = (1.0 - share) * table[low] + share * table[low + 1]
    before, half = x.copy(), np.zeros((STATES, STATES))
    # Loops: numba takes half a minute to compile products of matrices, and small ones run slower.
    for i in range(STATES):
        x[i] = step[i, STATES] * wheel
        for j in range(STATES):
            x[i] += step[i, j] * before[j]
            for k in range(STATES):
                half[i, j] += step[i, k] * covariance[k, j]
    for i in range(STATES):
        for j in range(STATES):
            covariance[i, j] = process[i] if i == j else 0.0
            for k in range(STATES):
                covariance[i, j] += half[i, k] * step[j, k]
    # The sine of the heading error moves the car sideways; at a start it may be large.
    middle = 0.5 * (before[THETA] + x[THETA])
    x[E] += step[E, THETA] * (math.sin(middle) - middle)


@compiled
def correct(x: Vector, covariance: Vector, index: int, value: float, variance: float) -> None:
    """Correct state (5,) and covariance (5, 5) by a measurement of one of the states."""
    gain = covariance[:, index] / (covariance[index, index] + variance)
    row = covariance[index].copy()
    x += gain * (value - x[index])
    for i in range(STATES):
        for j in range(STATES):
            covariance[i, j] -= gain[i] * row[j]
