"""Computes the gains of the linear quadratic regulator for a grid of speeds. SI units."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import solve_continuous_are, solve_discrete_are

from controllers.laws.lateral_model import LateralModel, Matrix
from runtime.jit import compiled

SLOWEST_M_S, FASTEST_M_S, GRID_M_S = 3.0, 45.0, 2.0
"""Limits and step of the grid of speeds. Below the grid the gains are constant, because the model
divides by the speed."""


@dataclass(frozen=True)
class LqrWeights:
    """Weights of the regulator's cost: Q = diag(offset, offset_rate, heading, heading_rate) for the
    state (m, m/s, rad, rad/s), and R = rho for the wheel angle (rad)."""

    offset: float
    offset_rate: float
    heading: float
    heading_rate: float
    rho: float

    @property
    def Q(self) -> Matrix:  # noqa: N802  # the matrix of the paper
        return np.diag([self.offset, self.offset_rate, self.heading, self.heading_rate])

    @property
    def R(self) -> Matrix:  # noqa: N802
        return np.array([[self.rho]])


def dlqr(A: Matrix, B: Matrix, Q: Matrix, R: Matrix) -> Matrix:
    """Return the gain K (inputs, states) of the law u = -K x for x[k+1] = A x[k] + B u[k].

    K minimises sum(x^T Q x + u^T R u). A and Q are (states, states), B (states, inputs), R (inputs,
    inputs).
    """
    P = solve_discrete_are(A, B, Q, R)
    gain: Matrix = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    return gain


def clqr(A: Matrix, B: Matrix, Q: Matrix, R: Matrix) -> Matrix:
    """Return the gain K (inputs, states) of the law u = -K x for dx/dt = A x + B u.

    K minimises integral(x^T Q x + u^T R u). A and Q are (states, states), B (states, inputs), R
    (inputs, inputs).
    """
    P = solve_continuous_are(A, B, Q, R)
    gain: Matrix = np.linalg.solve(R, B.T @ P)
    return gain


def discrete_gain(model: LateralModel, weights: LqrWeights, speed: float, dt: float) -> Matrix:
    """Return the gain K (4,), rad per unit of (e1, e1', e2, e2'), at one `speed` (m/s) for control
    steps of `dt` s."""
    A, B = model.discretise(speed, dt)
    gain: Matrix = dlqr(A, B, weights.Q, weights.R)[0]
    return gain


def speed_table(compute: Callable[[float], Matrix | tuple[float, ...]]) -> Matrix:
    """Return the results of `compute`, n numbers each, for the speeds 3, 5, ..., 45 m/s: an array
    (22, n), from which `row_at` interpolates."""
    speeds = np.arange(SLOWEST_M_S, FASTEST_M_S + GRID_M_S, GRID_M_S)
    return np.array([compute(float(speed)) for speed in speeds])


@compiled
def row_at(rows: Matrix, speed: float) -> Matrix:
    """Interpolate `rows` (22, n), a result of `speed_table`, linearly at `speed` m/s; return the
    row (n,).

    The first row also applies below 3 m/s, the last row above 45 m/s.
    """
    place = (min(max(speed, SLOWEST_M_S), FASTEST_M_S) - SLOWEST_M_S) / GRID_M_S
    low = min(int(place), len(rows) - 2)
    share = place - low
    row: Matrix = (1.0 - share) * rows[low] + share * rows[low + 1]
    return row


@lru_cache(maxsize=64)
def discrete_gains(weights: LqrWeights, dt: float) -> Matrix:
    """Return the gains (22, 4) of the discrete regulator for the paper's car, a result of
    `speed_table`.

    `dt` is the control step (s). The result is cached, because a command can make many equal
    controllers.
    """
    return speed_table(lambda speed: discrete_gain(LateralModel(), weights, speed, dt))


@lru_cache(maxsize=64)
def continuous_gains(weights: LqrWeights) -> Matrix:
    """Return the gains (22, 4) of the continuous regulator for the paper's car, a result of
    `speed_table`."""

    def gain(speed: float) -> Matrix:
        A, B, _ = LateralModel().matrices(speed)
        found: Matrix = clqr(A, B, weights.Q, weights.R)[0]
        return found

    return speed_table(gain)
