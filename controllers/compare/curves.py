"""The driving curves of a drive: true and perceived offset and angle over time."""

import numpy as np

from controllers.perception.perceived import Perceived
from simulator.arrays import FloatArray
from simulator.vehicle.state import CarState

MAX_POINTS = 400
COLUMNS = ("t", "d", "angle", "perceived_d", "perceived_angle")


class CurveRecorder:
    """An `Observer` that records the true and the perceived offset and angle in each step of a
    drive.

    The true offset is recorded from the track's centre. On a track with one lane, as in a
    comparison, it equals the offset from the lane's centre.
    """

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []

    def __call__(self, now: CarState, perceived: Perceived, steer: float) -> None:
        seen = np.nan if perceived.to_lane_centre is None else perceived.to_lane_centre
        self._rows.append((now.time_s, now.to_middle, now.angle, seen, perceived.angle))

    def curves(self) -> dict[str, list[float | None]]:
        """Return the recorded curves as lists by name: t (s), d, angle, perceived_d and
        perceived_angle (m, rad), with at most 400 points. None stands for an offset that was not
        perceived."""
        return curves_of(np.array(self._rows))


def curves_of(table: FloatArray) -> dict[str, list[float | None]]:
    """Return the columns of `table` (n, 5) as lists by name, thinned to at most 400 points.

    A row of `table` is a control step. The columns are t (s), d (m), angle (rad), perceived_d (m)
    and perceived_angle (rad). NaN, where nothing was perceived, becomes None. The steps are divided
    into parts of equal length. Each point is the step with the largest |d| in its part, so that no
    peak of d is lost.
    """
    chosen = [
        part[np.argmax(np.abs(table[part, 1]))]
        for part in np.array_split(np.arange(len(table)), min(MAX_POINTS, len(table)))
    ]
    return {
        name: [None if np.isnan(v) else round(float(v), 5) for v in table[chosen, column]]
        for column, name in enumerate(COLUMNS)
    }
