"""The linear single-track model of the paper's LQR. SI units.

Rajamani, "Vehicle Dynamics and Control", 2.5. The state is (e1, e1', e2, e2'): offset from the path
(m, left positive) and heading error (rad, counter-clockwise), with their rates.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from simulator.vehicle.car import CarParameters

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class LateralModel:
    """Linear single-track model of the paper's car.

    Mass in kg, yaw inertia in kg m2, axle distances in m, stiffness in N/rad of one tyre; an axle
    has two tyres.
    """

    mass: float = CarParameters.mass
    yaw_inertia: float = 2000.0
    front_axle: float = CarParameters.front_axle
    rear_axle: float = CarParameters.rear_axle
    front_stiffness: float = 80_000.0
    rear_stiffness: float = 80_000.0

    def matrices(self, speed: float) -> tuple[Matrix, Matrix, Matrix]:
        """Return A (4, 4), B (4, 1) and turn (4, 1) of x' = A x + B delta + turn * w at `speed`
        m/s, with the wheel angle delta (rad) and the turning rate w (rad/s) of the road, which is
        the speed times the road's curvature."""
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
        """Return the exact A (4, 4) and B (4, 1) of x[k+1] = A x[k] + B delta[k] for control steps
        of `dt` s with a constant wheel angle, at `speed` m/s."""
        A, B, _ = self.matrices(speed)
        block = np.zeros((5, 5))
        block[:4, :4], block[:4, 4:] = A, B
        step = expm(block * dt)
        return step[:4, :4], step[:4, 4:]

    def cornering(self, speed: float) -> tuple[float, float]:
        """Return the wheel angle per curvature and e2 per curvature (both rad m) in a steady bend
        with e1 = 0, at `speed` m/s.

        e2 is not zero in a bend: the car's heading differs from its path by the slip angle.
        """
        A, B, turn = self.matrices(speed)
        # 0 = A x + B delta + turn * speed * curvature with x = (0, 0, e2, 0).
        unknown = np.column_stack([B[[1, 3], 0], A[[1, 3], 2]])
        wheel_angle, heading = np.linalg.solve(unknown, -turn[[1, 3], 0] * speed)
        return float(wheel_angle), float(heading)
