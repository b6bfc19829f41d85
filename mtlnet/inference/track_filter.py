"""Track features over time: an extended Kalman filter over the answers to single images.

State: offset d (m, left positive) from the lane's centre, theta (rad, counter-clockwise, minus the
angle of the definitions) of the car to the road, curvature kappa (1/m, left positive) of the road:

    d' = v sin(theta) + vy cos(theta),  theta' = yaw rate - kappa v,  kappa: a random walk along it

The answers measure d and theta; their noise is the model's own `std`. A measurement that lies
farther from the prediction than `GATE` standard deviations is left out; when this goes on, the
filter begins anew with what is measured, as after a change of the lane. One filter a camera.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

USUAL_STD = (0.1, 0.015)  # m, rad: of a model without an uncertainty head
LEAST_STD = (0.02, 0.002)  # m, rad
CORRELATION = 2.0
"""Errors of successive images are alike: their standard deviations count for this much more."""
GATE = 4.0
RESTART_AFTER = 6
"""Measurements left out one after the other, before the filter begins anew."""
COAST_S = 0.5
"""Without a measured offset for this long, none is known any more."""
OFFSET_WALK = 0.05  # m per sqrt(s): what the model of the motion leaves out
ANGLE_WALK = 0.02  # rad per sqrt(s)
CURVATURE_WALK = 1.5e-3  # 1/m per sqrt(m)
CURVATURE_STD = 0.02  # 1/m: at the start, as of bends of 50 m
MAX_CURVATURE = 0.1  # 1/m


@dataclass(frozen=True, slots=True)
class Measured:
    """What the model answered to one image, and the standard deviations of its errors."""

    to_lane_centre: float | None
    """m, left positive."""
    angle: float
    """rad, positive when the car points to the right."""
    to_lane_centre_std: float = USUAL_STD[0]
    angle_std: float = USUAL_STD[1]

    @staticmethod
    def of(answer: Mapping[str, Any]) -> "Measured":
        """From an answer in the format of the service."""
        std = answer.get("std") or {}
        offset_std, angle_std = std.get("to_lane_centre"), std.get("angle")
        return Measured(
            answer["to_lane_centre_m"],
            float(answer["angle_rad"]),
            USUAL_STD[0] if offset_std is None else float(offset_std),
            USUAL_STD[1] if angle_std is None else float(angle_std),
        )


@dataclass(frozen=True, slots=True)
class Estimate:
    """The filtered features and their standard deviations; units and signs as in `Measured`."""

    to_lane_centre: float | None
    """None while no offset is known."""
    angle: float
    curvature: float
    """1/m, left positive."""
    to_lane_centre_std: float
    angle_std: float
    curvature_std: float


class TrackFilter:
    """The filter of one stream of images: `predict` to the next image's time, then `update`."""

    def __init__(self) -> None:
        self._x: Matrix | None = None
        self._p: Matrix = np.zeros((3, 3))
        self._left_out = 0
        self._offset_age_s = math.inf

    def predict(self, dt: float, speed: float, yaw_rate: float, lateral_speed: float = 0.0) -> None:
        """Move on by `dt` s at `speed` and `lateral_speed` (m/s) and `yaw_rate` (rad/s)."""
        self._offset_age_s += dt
        if self._x is None:
            return
        d, theta, kappa = self._x.tolist()
        turn = yaw_rate - kappa * speed
        middle = theta + 0.5 * dt * turn
        along = speed * math.cos(middle) - lateral_speed * math.sin(middle)
        d += dt * (speed * math.sin(middle) + lateral_speed * math.cos(middle))
        half = 0.5 * dt * speed
        step = np.array(
            [[1.0, dt * along, -dt * along * half], [0.0, 1.0, -2.0 * half], [0.0, 0.0, 1.0]]
        )
        walks = (OFFSET_WALK**2 * dt, ANGLE_WALK**2 * dt, CURVATURE_WALK**2 * abs(speed) * dt)
        self._x = np.array([d, theta + dt * turn, kappa])
        self._p = step @ self._p @ step.T + np.diag(walks)

    def update(self, measured: Measured) -> Estimate:
        """The estimate with one more measurement, taken at the time predicted to."""
        offset_std = CORRELATION * max(measured.to_lane_centre_std, LEAST_STD[0])
        angle_std = CORRELATION * max(measured.angle_std, LEAST_STD[1])
        if self._x is None or self._left_out >= RESTART_AFTER:
            self._begin(measured, offset_std, angle_std)
            return self.state
        within = self._correct(1, -measured.angle, angle_std)
        if measured.to_lane_centre is not None:
            offset_within = self._correct(0, measured.to_lane_centre, offset_std)
            if offset_within:
                self._offset_age_s = 0.0
            within = within and offset_within
        self._left_out = 0 if within else self._left_out + 1
        return self.state

    @property
    def state(self) -> Estimate:
        """The estimate at the time last predicted to. ValueError before the first update."""
        if self._x is None:
            raise ValueError("nothing was measured yet")
        d, theta, kappa = self._x.tolist()
        deviations = np.sqrt(np.diag(self._p)).tolist()
        known = self._offset_age_s <= COAST_S
        return Estimate(d if known else None, -theta, kappa, *deviations)

    def _begin(self, measured: Measured, offset_std: float, angle_std: float) -> None:
        """Begin with a measurement; of the state before only the curvature stays."""
        kappa, kappa_var = 0.0, CURVATURE_STD**2
        if self._x is not None:
            kappa, kappa_var = float(self._x[2]), float(self._p[2, 2])
        offset = measured.to_lane_centre
        self._x = np.array([offset or 0.0, -measured.angle, kappa])
        self._p = np.diag([offset_std**2 if offset is not None else 4.0, angle_std**2, kappa_var])
        self._left_out = 0
        self._offset_age_s = math.inf if offset is None else 0.0

    def _correct(self, row: int, value: float, std: float) -> bool:
        """Update by a measurement of one component; False where it was left out."""
        assert self._x is not None
        variance = float(self._p[row, row]) + std**2
        error = value - float(self._x[row])
        if not abs(error) <= GATE * math.sqrt(variance):
            return False
        gain = self._p[:, row] / variance
        # Joseph form: the covariance stays positive definite.
        rest = np.eye(3)
        rest[:, row] -= gain
        self._x = self._x + gain * error
        self._x[2] = min(max(self._x[2], -MAX_CURVATURE), MAX_CURVATURE)
        self._p = rest @ self._p @ rest.T + std**2 * np.outer(gain, gain)
        return True
