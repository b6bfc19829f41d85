"""The driving curves of a drive: true and perceived offset and angle over time."""

import numpy as np

from controllers.perception.perceived import Perceived
from simulator.arrays import FloatArray
from simulator.vehicle.state import CarState

MAX_POINTS = 400
COLUMNS = ("t", "d", "angle", "perceived_d", "perceived_angle")


class CurveRecorder:
    """An observer of a drive on one lane, whose centre is the centre of the track."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []

    def __call__(self, now: CarState, perceived: Perceived, steer: float) -> None:
        seen = np.nan if perceived.to_lane_centre is None else perceived.to_lane_centre
        self._rows.append((now.time_s, now.to_middle, now.angle, seen, perceived.angle))

    def curves(self) -> dict[str, list[float | None]]:
        """The curves of the steps so far, by `curves_of`."""
        return curves_of(np.array(self._rows))


def curves_of(table: FloatArray) -> dict[str, list[float | None]]:
    """The columns `COLUMNS` of the control steps `table` (n, 5), at up to `MAX_POINTS` points.

    A value is None where nothing was perceived. The steps are divided into parts of equal length,
    and each point is the step with the largest offset in its part, so that no peak is lost.
    """
    chosen = [
        part[np.argmax(np.abs(table[part, 1]))]
        for part in np.array_split(np.arange(len(table)), min(MAX_POINTS, len(table)))
    ]
    return {
        name: [None if np.isnan(v) else round(float(v), 5) for v in table[chosen, column]]
        for column, name in enumerate(COLUMNS)
    }
