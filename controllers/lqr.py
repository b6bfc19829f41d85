"""Linear quadratic regulator: the paper's first controller.

Minimises sum(x'Qx + rho delta^2) for the linear lateral model; the gains follow the speed.

Deviations from the paper:
- discretised at the control rate (zero-order hold), then the discrete Riccati equation: the
  continuous gains are bang-bang at 20 Hz and leave the road on alpine-2;
- gains scheduled by speed (a grid, interpolated linearly) in place of one design speed;
- two sets of weights for all tracks, where the paper tunes five numbers a track: one of the
  paper's for the exact state, and a softer one for a perceived state. With the errors of a briefly
  trained model (0.25 m, 0.025 rad) the car swings up to 4 m on alpine-2 with the paper's weights,
  0.6 m with the softer ones;
- feed-forward of the road's curvature, with the slip angle of a steady bend as the set point. On
  perception the curvature is estimated from the yaw rate (low-pass filter, its sign limited by the
  heading class), which removes the steady offset in bends.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

from controllers.interface import Observation
from controllers.torcs_feedback import steer_for
from trackfeatures import Heading

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


WEIGHTS_EXACT = LqrWeights(2.0, 0.2, 2.0, 0.1, 0.01)
"""The paper's for forza and g-track-3."""
WEIGHTS_PERCEIVED = LqrWeights(1.0, 1.0, 5.0, 1.0, 10.0)


@dataclass(frozen=True)
class LateralModel:
    """Linear single-track model of the paper's car (Rajamani, "Vehicle Dynamics and Control", 2.5).

    Masses in kg and kg m2, axle distances in m, stiffness in N/rad of one tyre; an axle has two.
    The state is (e1, e1', e2, e2'): offset from the path and heading error, m and rad, with rates.
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


def gain_at(model: LateralModel, weights: LqrWeights, speed: float, dt: float) -> Matrix:
    """K (4,) rad per unit of (e1, e1', e2, e2') at one speed (m/s) and control step (s)."""
    A, B = model.discretise(speed, dt)
    Q = np.diag([weights.offset, weights.offset_rate, weights.heading, weights.heading_rate])
    gain: Matrix = dlqr(A, B, Q, np.array([[weights.rho]]))[0]
    return gain


class Lqr:
    """Speed-scheduled LQR at a control step of `dt` s; the constructor computes all gains."""

    def __init__(
        self,
        dt: float = 0.05,
        weights: LqrWeights = WEIGHTS_EXACT,
        model: LateralModel | None = None,
        *,
        curvature_filter_s: float = 0.4,
    ) -> None:
        self.dt = dt
        self.weights = weights
        self.model = model or LateralModel()
        self._speeds = np.arange(SLOWEST_M_S, FASTEST_M_S + GRID_M_S, GRID_M_S)
        self._gains = np.array([gain_at(self.model, self.weights, v, dt) for v in self._speeds])
        self._steady_bends = np.array([self.model.cornering(v) for v in self._speeds])
        self._blend = dt / (dt + curvature_filter_s)
        self._curvature = 0.0

    def gain(self, speed: float) -> Matrix:
        """K (4,) at `speed` m/s."""
        return self._interpolate(speed, self._gains)

    def update(self, observation: Observation) -> float:
        speed = max(observation.vx, SLOWEST_M_S)
        curvature = self._road_curvature(observation)
        theta = -observation.angle
        wheel_per_bend, theta_per_bend = self._interpolate(speed, self._steady_bends)
        error = np.array(
            [
                observation.to_lane_centre,
                observation.vy + observation.vx * math.sin(theta),
                theta - theta_per_bend * curvature,
                observation.yaw_rate - observation.vx * curvature,
            ]
        )
        wheel_angle = wheel_per_bend * curvature - float(self.gain(speed) @ error)
        return steer_for(float(wheel_angle))

    def _road_curvature(self, observation: Observation) -> float:
        """The measured curvature, or one estimated from yaw rate and speed where there is none."""
        if observation.curvature is not None:
            return observation.curvature
        turning = observation.yaw_rate / max(observation.vx, SLOWEST_M_S)
        self._curvature += self._blend * (turning - self._curvature)
        if observation.heading is Heading.LEFT:
            self._curvature = max(self._curvature, 0.0)
        elif observation.heading is Heading.RIGHT:
            self._curvature = min(self._curvature, 0.0)
        return self._curvature

    def _interpolate(self, speed: float, table: Matrix) -> Matrix:
        """Linear interpolation of the rows of `table` at `speed`, constant beyond the grid."""
        place = (min(max(speed, SLOWEST_M_S), FASTEST_M_S) - SLOWEST_M_S) / GRID_M_S
        low = min(int(place), len(table) - 2)
        share = place - low
        row: Matrix = (1.0 - share) * table[low] + share * table[low + 1]
        return row
