"""The linear single-track model of the paper's LQR, and its gains by speed. SI units.

Rajamani, "Vehicle Dynamics and Control", 2.5. The state is (e1, e1', e2, e2'): offset from the path
(m, left positive) and heading error (rad, counter-clockwise), with their rates.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_continuous_are, solve_discrete_are

Matrix = NDArray[np.float64]

SLOWEST_M_S = 3.0
"""The model divides by the speed; below this speed the gains are constant."""
FASTEST_M_S = 45.0
GRID_M_S = 2.0


@dataclass(frozen=True)
class LqrWeights:
    """Q = diag(offset, offset_rate, heading, heading_rate) and R = rho."""

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


@dataclass(frozen=True)
class LateralModel:
    """Linear single-track model of the paper's car.

    Masses in kg and kg m2, axle distances in m, stiffness in N/rad of one tyre; an axle has two.
    """

    mass: float = 1150.0
    yaw_inertia: float = 2000.0
    front_axle: float = 1.27
    rear_axle: float = 1.37
    front_stiffness: float = 80_000.0
    rear_stiffness: float = 80_000.0

    def matrices(self, speed: float) -> tuple[Matrix, Matrix, Matrix]:
        """A (4, 4), B (4, 1) and the column (4, 1) of the road's turning rate, at `speed` m/s."""
        m, inertia, lf, lr = self.mass, self.yaw_inertia, self.front_axle, self.rear_axle
        front, rear = 2.0 * self.front_stiffness, 2.0 * self.rear_stiffness
        total, moment = front + rear, -front * lf + rear * lr
        spin = -front * lf**2 - rear * lr**2
        A = np.array(
            [
                [0.0, 1.0, 0.0, 0.0],
                [0.0, -total / (m * speed), total / m, moment / (m * speed)],
                [0.0, 0.0, 0.0, 1.0],
                [0.0, moment / (inertia * speed), -moment / inertia, spin / (inertia * speed)],
            ]
        )
        B = np.array([[0.0], [front / m], [0.0], [front * lf / inertia]])
        turn = np.array([[0.0], [moment / (m * speed) - speed], [0.0], [spin / (inertia * speed)]])
        return A, B, turn

    def discretise(self, speed: float, dt: float) -> tuple[Matrix, Matrix]:
        """A (4, 4) and B (4, 1) over one control step with the wheel angle held (exact)."""
        A, B, _ = self.matrices(speed)
        block = np.zeros((5, 5))
        block[:4, :4], block[:4, 4:] = A, B
        step = expm(block * dt)
        return step[:4, :4], step[:4, 4:]

    def cornering(self, speed: float) -> tuple[float, float]:
        """Wheel angle and e2 per unit of curvature, rad m, in a steady bend with e1 = 0.

        e2 is not zero in a bend: the car points off its path by its slip angle.
        """
        A, B, turn = self.matrices(speed)
        # 0 = A x + B delta + turn * speed * curvature with x = (0, 0, e2, 0).
        unknown = np.column_stack([B[[1, 3], 0], A[[1, 3], 2]])
        wheel_angle, heading = np.linalg.solve(unknown, -turn[[1, 3], 0] * speed)
        return float(wheel_angle), float(heading)


def dlqr(A: Matrix, B: Matrix, Q: Matrix, R: Matrix) -> Matrix:
    """Gain K (inputs, states) of u = -K x for x' = A x + B u, cost sum(x'Qx + u'Ru)."""
    P = solve_discrete_are(A, B, Q, R)
    gain: Matrix = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    return gain


def clqr(A: Matrix, B: Matrix, Q: Matrix, R: Matrix) -> Matrix:
    """Gain K (inputs, states) of u = -K x for dx/dt = A x + B u, cost integral(x'Qx + u'Ru)."""
    P = solve_continuous_are(A, B, Q, R)
    gain: Matrix = np.linalg.solve(R, B.T @ P)
    return gain


def discrete_gain(model: LateralModel, weights: LqrWeights, speed: float, dt: float) -> Matrix:
    """K (4,) rad per unit of (e1, e1', e2, e2') at one speed (m/s) and control step (s)."""
    A, B = model.discretise(speed, dt)
    gain: Matrix = dlqr(A, B, weights.Q, weights.R)[0]
    return gain


def continuous_gain(model: LateralModel, weights: LqrWeights, speed: float) -> Matrix:
    """K (4,) of the continuous regulator at one speed (m/s)."""
    A, B, _ = model.matrices(speed)
    gain: Matrix = clqr(A, B, weights.Q, weights.R)[0]
    return gain


class SpeedTable:
    """Rows computed at a grid of speeds, interpolated linearly, constant beyond the grid."""

    def __init__(self, row_at: Callable[[float], Matrix | tuple[float, ...]]) -> None:
        speeds = np.arange(SLOWEST_M_S, FASTEST_M_S + GRID_M_S, GRID_M_S)
        self._rows = np.array([row_at(float(speed)) for speed in speeds])

    def __call__(self, speed: float) -> Matrix:
        """The row (n,) at `speed` m/s."""
        place = (min(max(speed, SLOWEST_M_S), FASTEST_M_S) - SLOWEST_M_S) / GRID_M_S
        low = min(int(place), len(self._rows) - 2)
        share = place - low
        row: Matrix = (1.0 - share) * self._rows[low] + share * self._rows[low + 1]
        return row


@lru_cache(maxsize=64)
def discrete_gains(model: LateralModel, weights: LqrWeights, dt: float) -> SpeedTable:
    """`discrete_gain` by speed. Kept: commands make many controllers of one kind."""
    return SpeedTable(lambda speed: discrete_gain(model, weights, speed, dt))


@lru_cache(maxsize=64)
def continuous_gains(model: LateralModel, weights: LqrWeights) -> SpeedTable:
    """`continuous_gain` by speed."""
    return SpeedTable(lambda speed: continuous_gain(model, weights, speed))
