"""The car's sideways motion as a linear model in its errors against the road.

Rajamani, "Vehicle Dynamics and Control", 2nd ed., section 2.5; the paper's equation of the LQR.
State x = (e1, e1', e2, e2'): offset from the lane's centre (m, left positive), its rate, heading
error (rad, counter-clockwise positive, so minus `angle`), its rate. Input: front wheel angle (rad).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class LateralModel:
    """The paper's car; stiffness is that of one tyre, and an axle has two."""

    mass: float = 1150.0
    yaw_inertia: float = 2000.0
    front_axle: float = 1.27
    rear_axle: float = 1.37
    front_stiffness: float = 80_000.0
    rear_stiffness: float = 80_000.0

    def matrices(self, speed: float) -> tuple[Matrix, Matrix, Matrix]:
        """A (4, 4), B (4, 1) and the effect of the road's turning rate (4, 1) at `speed` m/s."""
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
        """Per unit of curvature (1/m) in a steady bend with e1 = 0: (wheel angle, e2), rad m.

        The heading error is not zero in a bend: the car's nose points off its path by its slip.
        """
        A, B, turn = self.matrices(speed)
        # 0 = A x + B delta + turn * speed * curvature with x = (0, 0, e2, 0).
        unknown = np.column_stack([B[[1, 3], 0], A[[1, 3], 2]])
        wheel_angle, heading = np.linalg.solve(unknown, -turn[[1, 3], 0] * speed)
        return float(wheel_angle), float(heading)
