"""The driving curves of a drive, true and perceived, and its quadratic reward."""

import numpy as np

from controllers.closed_loop import DriveResult
from controllers.perception import Perceived
from controllers.torcs_feedback import STEERING_LOCK
from simulator.vehicle.state import CarState

MAX_POINTS = 400
COLUMNS = ("t", "d", "angle", "perceived_d", "perceived_angle")


def quadratic_reward(d: float, angle: float, steer: float) -> float:
    """The paper's quadratic reward -(0.3 e1^2 + e2^2 + 0.03 delta^2), m and rad."""
    delta = steer * STEERING_LOCK
    return -(0.3 * d * d + angle * angle + 0.03 * delta * delta)


class CurveRecorder:
    """An observer of a drive on one lane, whose centre is the track's."""

    def __init__(self) -> None:
        self.quadratic = 0.0
        """Sum of the quadratic rewards."""
        self._rows: list[tuple[float, ...]] = []

    def __call__(self, now: CarState, perceived: Perceived, steer: float) -> None:
        self.quadratic += quadratic_reward(now.to_middle, now.angle, steer)
        seen = np.nan if perceived.to_lane_centre is None else perceived.to_lane_centre
        self._rows.append((now.time_s, now.to_middle, now.angle, seen, perceived.angle))

    def quadratic_per_step(self, result: DriveResult) -> float:
        """The quadratic reward over the steps asked for; each that an early end left out: -2."""
        missing = result.steps_asked - result.steps
        return (self.quadratic - 2.0 * missing) / result.steps_asked

    def curves(self) -> dict[str, list[float | None]]:
        """The columns, at most `MAX_POINTS` points long; None where nothing was perceived.

        Of each stretch the step with the largest offset is kept, so that no peak is lost.
        """
        table = np.array(self._rows)
        chosen = [
            part[np.argmax(np.abs(table[part, 1]))]
            for part in np.array_split(np.arange(len(table)), min(MAX_POINTS, len(table)))
        ]
        return {
            name: [None if np.isnan(v) else round(float(v), 5) for v in table[chosen, column]]
            for column, name in enumerate(COLUMNS)
        }
