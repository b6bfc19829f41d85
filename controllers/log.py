"""The log of a drive: CSV in the columns of the reference laps of the real TORCS.

One row a control step: the state the controller saw, and the steering it answered with.
"""

from typing import TextIO

from simulator.state import CarState

COLUMNS = ("t", "s", "d", "th", "v", "vx", "vy", "yr", "steer", "rpm", "lap", "x", "y", "z")
"""s, m along the track; m left of its centre; rad yaw minus tangent; m/s; rad/s; [-1, 1]; m."""


class DriveLog:
    """Writes to an open text file; each row is complete when `write` returns."""

    def __init__(self, file: TextIO) -> None:
        self._file = file
        file.write(",".join(COLUMNS) + "\n")

    def write(self, state: CarState, steer: float) -> None:
        # theta is counter-clockwise in the reference laps, `angle` clockwise in ours.
        self._file.write(
            f"{state.time_s:.3f},{state.s:.3f},{state.to_middle:.5f},{-state.angle:.6f},"
            f"{state.speed:.4f},{state.vx:.4f},{state.vy:.4f},{state.yaw_rate:.6f},{steer:.6f},"
            f"{state.rpm:.1f},{state.lap},{state.x:.4f},{state.y:.4f},{state.z:.4f}\n"
        )
