"""Estimates the car's state relative to the road from noisy and late measurements. SI units.

The estimator is a Kalman filter with the linear single-track model (Rajamani, "Vehicle Dynamics and
Control", 2.2). Its state is (e, theta, vy, r, kappa): offset from the line (m, left positive),
heading error (rad, counter-clockwise), lateral speed (m/s), yaw rate (rad/s) and the curvature of
the road (1/m), which is modelled as a random walk.

A perception measures e and theta, possibly late; the car measures vy and r without delay. The
filter estimates the state at the moment of the image, and predicts this state to the present with
the car's measurements and the steering since the image (the Smith predictor of a known delay). The
delay is estimated (`controllers.laws.delay`). The variance of the measurements' noise is estimated
from their third differences, in which motion nearly cancels and noise does not.
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from controllers.interface import ANGLE, TO_LANE_CENTRE, VX, VY, YAW_RATE, Observations
from controllers.laws.delay import MAX_DELAY, first_delays, update_delay
from controllers.laws.lateral_model import LateralModel
from controllers.laws.lqr_gains import FASTEST_M_S, GRID_M_S, SLOWEST_M_S
from runtime.jit import compiled, compiled_for_threads

Vector = NDArray[np.float64]

E, THETA, V, R, KAPPA = range(5)
STATES, MEASURED = 5, 4
CAR = LateralModel(
    mass=1230.0, yaw_inertia=1120.0, front_stiffness=125_000.0, rear_stiffness=125_000.0
)
"""The car with its fuel. Yaw inertia and tyre stiffness are estimated from the recorded TORCS laps
(`simulator.vehicle.car`); the paper's values differ."""
PROCESS_STD = np.array([0.003, 0.0007, 0.02, 0.02, 0.0005])
"""Standard deviations of the model's error (e, theta, vy, r, kappa) per control step, at speeds of
at least USUAL_M_S."""
USUAL_M_S, SLOWEST_SHARE = 15.0, 0.1
"""Below USUAL_M_S (m/s) the standard deviations fall in proportion to the speed, but not below a
tenth of PROCESS_STD, because the state of a slow car changes less in a control step."""
START_STD = np.array([0.1, 0.05, 0.1, 0.1, 0.02])
LEAST_STD = np.array([1e-3, 2e-4, 1e-2, 1e-3])
MOST_STD = np.array([0.2, 0.02, 0.12, 0.012])
"""Lower and upper limits of the standard deviations of the measurements' noise (e, theta, vy, r).
Because of the upper limits each sensor always has some weight, and the motion of an oscillating car
is not taken for noise."""
NOISE_STEPS = 100
"""Control steps over which the variance of the noise is averaged."""
THIRD_DIFFERENCE = 20.0
"""Variance of a third difference of white noise: 1 + 9 + 9 + 1 times the variance of the noise."""


STATE_MEMORY = np.dtype(
    [
        ("x", np.float64, STATES),
        ("covariance", np.float64, (STATES, STATES)),
        # vx, vy, yaw rate and wheel angle of the last control steps, newest first.
        ("own", np.float64, (MAX_DELAY + 2, 4)),
        ("recent", np.float64, (4, MEASURED)),
        # Variance of the noise of (e, theta, vy, r), without limits.
        ("noise_variance", np.float64, MEASURED),
        ("steps", np.int64),
        # The last finite e, theta, vx, vy and yaw rate.
        ("last", np.float64, 5),
    ]
)
"""The values that the filter of one car keeps between two control steps. Initially all are zero,
except the last speed."""
SPEED = 2
"""Index of vx in the field `last`."""


class StateEstimate:
    """Estimates the states of N cars in each control step of `dt` s.

    `delay_s`: the delay of the perception, s; None if it is unknown.
    """

    def __init__(self, dt: float, delay_s: float | None = None) -> None:
        self._dt, self._delay_s = dt, delay_s
        self._table = transitions(dt)
        self.delays = first_delays(0, dt, delay_s)
        self.memory = np.zeros(0, STATE_MEMORY)

    @property
    def speeds(self) -> Vector:
        """Forward speeds vx (N,) of the cars in the last control step, m/s."""
        speeds: Vector = self.memory["last"][:, SPEED]
        return speeds

    def update(self, observations: Observations, wheel_angles: Vector) -> Vector:
        """Return the present states (N, 5), e, theta, vy, r and kappa, after the observations of
        this control step.

        `wheel_angles` (N,): angles (rad) of the front wheels since the last control step. A
        measurement that is not finite is replaced by the last finite one, because otherwise it
        would stay in the filter.
        """
        if len(self.memory) != len(observations):
            self.delays = first_delays(len(observations), self._dt, self._delay_s)
            self.memory = np.zeros(len(observations), STATE_MEMORY)
            self.memory["last"][:, SPEED] = SLOWEST_M_S
        rows, dt = observations.rows, self._dt
        return estimate_states(rows, wheel_angles, self.memory, self.delays, self._table, dt)


@compiled_for_threads
def estimate_states(
    seen: Vector, wheel_angles: Vector, memory: Any, delays: Any, table: Vector, dt: float
) -> Vector:
    """Return the present states (N, 5) of N cars after their observations `seen` (N, 7), the rows
    of `Observations`.

    `memory` (N,) of the type STATE_MEMORY and `delays` (N,) of the type DELAY_MEMORY are updated in
    place. `wheel_angles` (N,) is in rad. `table` is the result of `transitions(dt)`.
    """
    states = np.empty((len(seen), STATES))
    for k in range(len(seen)):
        states[k] = estimate_state(seen[k], wheel_angles[k], memory[k], delays[k], table, dt)
    return states


@compiled
def estimate_state(
    seen: Vector, wheel_angle: float, memory: Any, delay: Any, table: Vector, dt: float
) -> Vector:
    """Return the present state (5,) of one car after its observation `seen` (7,).

    `memory` (a STATE_MEMORY) and `delay` (a DELAY_MEMORY) of the car are updated in place.
    `wheel_angle` is in rad. `table` is the result of `transitions(dt)`.
    """
    own, x, last = memory.own, memory.x, memory.last
    note_finite(0, seen[TO_LANE_CENTRE], last)
    note_finite(1, -seen[ANGLE], last)
    note_finite(SPEED, seen[VX], last)
    note_finite(3, seen[VY], last)
    note_finite(4, seen[YAW_RATE], last)
    vx, vy, yaw_rate = last[SPEED], last[3], last[4]
    for row in range(MAX_DELAY + 1, 0, -1):
        for column in range(4):
            own[row, column] = own[row - 1, column]
    own[1, 3] = wheel_angle
    for row in range(MAX_DELAY + 2 if memory.steps == 0 else 1):
        own[row, 0], own[row, 1], own[row, 2] = vx, vy, yaw_rate
    measured = np.empty(MEASURED)
    measured[E], measured[THETA], measured[V], measured[R] = last[0], last[1], vy, yaw_rate
    changed = update_delay(delay, measured[THETA], measured[R], dt)
    if changed or memory.steps == 0:
        x[E], x[THETA] = measured[E], measured[THETA]
        x[V], x[R] = own[delay.steps, 1], own[delay.steps, 2]
        for i in range(STATES):
            for j in range(STATES):
                memory.covariance[i, j] = START_STD[i] ** 2 if i == j else 0.0
    note_noise(measured, memory)
    memory.steps += 1
    share = min(max(vx / USUAL_M_S, SLOWEST_SHARE), 1.0)
    variance, process = np.empty(MEASURED), np.empty(STATES)
    for k in range(MEASURED):
        variance[k] = min(max(memory.noise_variance[k], LEAST_STD[k] ** 2), MOST_STD[k] ** 2)
    for k in range(STATES):
        process[k] = (PROCESS_STD[k] * share) ** 2
    return advance(x, memory.covariance, table, own, measured, variance, process, delay.steps)


@compiled
def note_finite(place: int, value: float, last: Vector) -> None:
    if math.isfinite(value):
        last[place] = value


@compiled
def note_noise(measured: Vector, memory: Any) -> None:
    """Update the estimated variances of the noise, `memory.noise_variance` (4,), from the third
    differences over time of the measurements.

    `measured` (4,): offset (m), heading error (rad), lateral speed (m/s) and yaw rate (rad/s).
    `memory` is the STATE_MEMORY of one car.
    """
    recent, variance = memory.recent, memory.noise_variance
    for k in range(MEASURED):
        for row in range(len(recent) - 1, 0, -1):
            recent[row, k] = recent[row - 1, k]
        recent[0, k] = measured[k]
    if memory.steps < len(recent) - 1:
        return
    weight = 1.0 / min(memory.steps - 2, NOISE_STEPS)
    for k in range(MEASURED):
        difference = recent[0, k] - 3.0 * recent[1, k] + 3.0 * recent[2, k] - recent[3, k]
        variance[k] += weight * (difference**2 / THIRD_DIFFERENCE - variance[k])


@lru_cache(maxsize=8)
def transitions(dt: float) -> Vector:
    """Return the exact transition matrices (22, 5, 6) over `dt` s for vx = 3, 5, ..., 45 m/s.

    A matrix times the state (5) and the wheel angle (rad) is the next state.
    """
    speeds = np.arange(SLOWEST_M_S, FASTEST_M_S + GRID_M_S, GRID_M_S)
    return np.array([_transition(float(speed), dt) for speed in speeds])


def _transition(speed: float, dt: float) -> Vector:
    lateral, wheel, turn = CAR.matrices(speed)
    block = np.zeros((STATES + 1, STATES + 1))
    block[E, THETA], block[E, V] = speed, 1.0
    block[THETA, R], block[THETA, KAPPA] = 1.0, -speed
    # `LateralModel` has the state e' = vy + vx theta in place of vy, so the derivatives with
    # respect to e' are the derivatives with respect to vy.
    block[V, V], block[V, R] = lateral[1, 1], turn[1, 0]
    block[R, V], block[R, R] = lateral[3, 1], lateral[3, 3]
    block[V, STATES], block[R, STATES] = wheel[1, 0], wheel[3, 0]
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
    """Advance the filter of one car by one control step; return the present state (5,).

    `x` (5,) and `covariance` (5, 5) are the state at the moment of the image, `delay` steps ago;
    both are updated in place. `table`: the result of `transitions`. `own` (6, 4): vx, vy (m/s), yaw
    rate (rad/s) and wheel angle (rad) of the last steps, newest first. The first two elements of
    `seen` are e and theta of the image. `variance` (4,): variances of the measurements. `process`
    (5,): variances of the model's error per step.
    """
    predict(x, covariance, table, own[delay + 1, 0], own[delay + 1, 3], process)
    correct(x, covariance, V, own[delay, 1], variance[V])
    correct(x, covariance, R, own[delay, 2], variance[R])
    correct(x, covariance, THETA, seen[1], variance[THETA])
    correct(x, covariance, E, seen[0], variance[E])
    present, spread = x.copy(), covariance.copy()
    for step in range(delay - 1, -1, -1):
        predict(present, spread, table, own[step + 1, 0], own[step + 1, 3], process)
        correct(present, spread, V, own[step, 1], variance[V])
        correct(present, spread, R, own[step, 2], variance[R])
    return present


@compiled
def predict(
    x: Vector, covariance: Vector, table: Vector, vx: float, wheel: float, process: Vector
) -> None:
    """Replace state `x` (5,) and covariance (5, 5) by their predictions for the next control step.

    `vx` (m/s) and `wheel` (rad) are the speed and the wheel angle during the step. `table` is the
    result of `transitions`. `process` (5,): variances of the model's error per step.
    """
    place = (min(max(vx, SLOWEST_M_S), FASTEST_M_S) - SLOWEST_M_S) / GRID_M_S
    low = min(int(place), len(table) - 2)
    share = place - low
    step = (1.0 - share) * table[low] + share * table[low + 1]
    before, half = x.copy(), np.zeros((STATES, STATES))
    # Loops, because numba takes half a minute to compile products of matrices, and products of
    # small matrices are slower than loops.
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
    # The lateral motion depends on the sine of the heading error, which can be large at a start.
    middle = 0.5 * (before[THETA] + x[THETA])
    x[E] += step[E, THETA] * (math.sin(middle) - middle)


@compiled
def correct(x: Vector, covariance: Vector, index: int, value: float, variance: float) -> None:
    """Correct state `x` (5,) and covariance (5, 5) by a measurement `value` of `x[index]`."""
    gain = covariance[:, index] / (covariance[index, index] + variance)
    row = covariance[index].copy()
    x += gain * (value - x[index])
    for i in range(STATES):
        for j in range(STATES):
            covariance[i, j] -= gain[i] * row[j]
