"""The driving curves of a drive: true and perceived offset and angle over time."""

import numpy as np

from controllers.perception.perceived import Perceived
from simulator.arrays import FloatArray
from simulator.vehicle.state import CarState

MAX_POINTS = 400
COLUMNS = ("t", "d", "angle", "perceived_d", "perceived_angle")


class CurveRecorder:
    """An observer that records the curves of a drive on a track with one lane.

    The offset from the track's centre is then also the offset from the lane's centre.
    """

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []

    def __call__(self, now: CarState, perceived: Perceived, steer: float) -> None:
        seen = np.nan if perceived.to_lane_centre is None else perceived.to_lane_centre
        self._rows.append((now.time_s, now.to_middle, now.angle, seen, perceived.angle))

    def curves(self) -> dict[str, list[float | None]]:
        """Return the curves of the steps so far, in the format of `curves_of`."""
        return curves_of(np.array(self._rows))


def curves_of(table: FloatArray) -> dict[str, list[float | None]]:
    """Return the columns of `table`, called `COLUMNS`, thinned to at most `MAX_POINTS` points.

    `table` (n, 5) has a row for each control step: s, m, rad, m, rad. NaN (nothing was perceived)
    becomes None. The steps are divided into parts of equal length, and each point is the step with
    the largest offset in its part, so that no peak is lost.
    """
    chosen = [
        part[np.argmax(np.abs(table[part, 1]))]
        for part in np.array_split(np.arange(len(table)), min(MAX_POINTS, len(table)))
    ]
    return {
        name: [None if np.isnan(v) else round(float(v), 5) for v in table[chosen, column]]
        for column, name in enumerate(COLUMNS)
    }
