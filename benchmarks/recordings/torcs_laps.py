"""Compares a flying lap of the simulated car with a flying lap in the real TORCS, both under the
same control law.

A recording is a CSV file in `drives/`. It contains laps in TORCS under the control law of
`controllers.laws.torcs_feedback`. The same law drives the simulated car from the same start, with
the recorded durations of the control steps. The durations matter because the gains of the law are
high: TORCS sends its state every 20 to 22 ms, so its control steps take 40 to 66 ms.
"""

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controllers.drive.closed_loop import GEAR
from controllers.drive.config import THROTTLE
from controllers.interface import Observation
from controllers.laws.torcs_feedback import StateFeedback
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import CarState, Command
from simulator.world.control_rate import PHYSICS_HZ
from simulator.world.world import World
from trackfeatures import RoadClass, UserError

TRACKS = ("forza", "g-track-3")
FLYING_LAP = 2
LIMITS = {"steps": 0.01, "score_per_step": 0.004, "mean_abs_d_m": 0.02, "max_abs_d_m": 0.15}
"""Largest allowed differences of the two laps: relative for the number of steps, absolute for all
other figures."""
EVEN_STEPS = PHYSICS_HZ // 20
"""Number of physics steps in a control step of 50 ms."""

Rows = NDArray[Any]


@dataclass(frozen=True)
class Lap:
    """The figures of one flying lap; `d` is the offset from the centre line."""

    steps: int
    score_per_step: float
    mean_abs_d_m: float
    max_abs_d_m: float
    least_speed_kmh: float
    most_speed_kmh: float


@dataclass(frozen=True)
class Fit:
    """A flying lap in the simulator (`here`) and a flying lap in TORCS (`torcs`) on the same
    track."""

    track: str
    here: Lap
    torcs: Lap

    @property
    def difference(self) -> dict[str, float]:
        """The value in the simulator minus the value in TORCS for each name in LIMITS. For the
        number of steps the difference is relative."""
        apart = {name: getattr(self.here, name) - getattr(self.torcs, name) for name in LIMITS}
        return apart | {"steps": apart["steps"] / self.torcs.steps}

    @property
    def within(self) -> dict[str, bool]:
        """Whether the difference is within the limit, for each name in LIMITS."""
        return {name: abs(apart) <= LIMITS[name] for name, apart in self.difference.items()}


def read_recording(path: Path) -> Rows:
    """Return the rows of a drive in TORCS from the CSV file `path`, as a structured array with the
    names of the columns.

    Raises UserError if the file cannot be read.
    """
    try:
        return np.genfromtxt(path, delimiter=",", names=True, skip_header=1)
    except OSError as error:
        raise UserError(f"no recorded laps at {path}: {error}") from error


def compare(name: str, drives: Path, *, as_recorded: bool = True) -> Fit:
    """Drive the laps of `drives`/NAME-lqr.csv in the simulator and compare the flying laps.

    With `as_recorded=False` the control steps take 50 ms instead of the recorded times.
    """
    recording = read_recording(drives / f"{name}-lqr.csv")
    road = Road(find_track(name))
    ticks = np.round(recording["t"] * PHYSICS_HZ).astype(int)
    holds = np.diff(ticks).tolist() if as_recorded else [EVEN_STEPS]
    states = drive_laps(road, float(recording["d"][0]), holds)
    here = np.array(
        [(now.to_middle, -now.angle, now.speed) for now in states],
        dtype=[("d", "f8"), ("th", "f8"), ("v", "f8")],
    )
    torcs = recording[recording["lap"] == FLYING_LAP]
    return Fit(name, figures(here, road.half_width), figures(torcs, road.half_width))


def drive_laps(road: Road, start_d: float, holds: list[int]) -> list[CarState]:
    """Drive from offset `start_d` (m) and return the state at each control step of the flying lap.

    `holds`: number of physics steps of each control step. If the drive has more control steps, the
    list is repeated from its start. Raises UserError if the car leaves the track.
    """
    law, states = StateFeedback(), []
    with World(road, frequency_hz=PHYSICS_HZ) as world:
        now = world.reset(seed=0, to_middle=start_d)
        for hold in itertools.cycle(holds):
            if now.lap == FLYING_LAP:
                states.append(now)
            command = Command(
                law.update(_observed(now, world.features().heading)), THROTTLE, gear=GEAR
            )
            for _ in range(hold):
                now = world.step(command)
            if now.lap > FLYING_LAP:
                return states
            if now.off_track or now.backwards:
                raise UserError(f"the law left {road.track.name!r} at s = {now.s:.0f} m")
    raise AssertionError("a cycle does not end")


def figures(lap: Rows, half_width: float) -> Lap:
    """Return the figures of a lap. A row of `lap` is a control step with d (m), th (rad, yaw minus
    track tangent) and v (m/s). `half_width` is half of the track's width in m."""
    offset, speed = np.abs(lap["d"]), 3.6 * lap["v"]
    score = np.cos(lap["th"]) - np.abs(np.sin(lap["th"])) - offset / half_width
    return Lap(
        len(lap),
        float(score.mean()),
        float(offset.mean()),
        float(offset.max()),
        float(speed.min()),
        float(speed.max()),
    )


def _observed(now: CarState, heading: RoadClass) -> Observation:
    return Observation(
        to_lane_centre=now.to_middle,
        angle=now.angle,
        heading=heading,
        vx=now.vx,
        vy=now.vy,
        yaw_rate=now.yaw_rate,
        curvature=now.curvature,
    )
