"""What a drive amounts to."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Protocol, TextIO, TypeVar

import numpy as np

from controllers.interface import Controller, Observation
from controllers.perception import Perceived
from simulator.env.reward import ending, step_reward
from simulator.track.road import Road
from simulator.traffic.idm import idm_acceleration
from simulator.traffic.traffic import Traffic
from simulator.vehicle.state import CarState, Command


@dataclass(frozen=True, slots=True)
class DriveResult:
    """A drive's score and the figures that belong beside it."""

    steps: int
    """Control steps driven: those asked for, unless the drive ended."""
    steps_asked: int
    score: float
    """Sum of the reward over the steps asked for; an ending step gives -2, those after it 0."""
    score_per_step: float
    """`score` over `steps_asked`."""
    laps: int
    """Whole laps, from crossing the line to crossing it again."""
    distance_m: float
    """Way made by the car."""
    mean_abs_d_m: float
    """Mean distance from the centre of the lane to follow."""
    max_abs_d_m: float
    speed_kmh: tuple[float, float]
    """Slowest and fastest, the standing start included."""
    cruising_kmh: tuple[float, float] | None
    """The same without the first 15 s; None for a shorter drive."""
    blind_steps: int
    """Steps without a perceived offset."""
    noisy: bool
    """Whether noise was added to the state."""
    ended: str | None
    """Why it ended early: off_track (touching a wall too), backwards, or collision (with a car)."""

    def as_json(self) -> dict[str, Any]:
        values = asdict(self)
        values["speed_kmh"] = list(self.speed_kmh)
        if self.cruising_kmh is not None:
            values["cruising_kmh"] = list(self.cruising_kmh)
        return values


# The log of a drive: CSV in the columns of the reference laps of the real TORCS. One row a control
# step: the state the controller saw, and the steering it answered with.


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


# Closed-loop driving: perceive, steer, step, score. Throttle is held open loop, as in the paper. A
# run of `run_lap` is a function of the world's reset, the controller and the perception alone.


GEAR = 1
THROTTLE = 0.2
HOLD_S = 0.5
"""A lost offset is held this long; then the car is steered along the road until one is seen."""
RUN_UP_S = 15.0
EASE_OFF = 1.0  # m/s2 of wanted braking at which the throttle is closed
FULL_BRAKING = 15.0  # m/s2 at full brake on asphalt


class Drivable(Protocol):
    """What a drive needs of `simulator.world.world.World`."""

    road: Road
    frequency_hz: int
    traffic: Traffic

    @property
    def state(self) -> CarState: ...

    def step(self, command: Command) -> CarState: ...


World = TypeVar("World", bound=Drivable)


def run_lap(
    world: World,
    controller: Controller,
    perceive: Callable[[World], Perceived],
    steps: int,
    *,
    throttle: float = THROTTLE,
    lane_centre: float = 0.0,
    record: Callable[[CarState, float], None] | None = None,
) -> DriveResult:
    """Drives `steps` control steps from where the world stands, or until the episode ends.

    `lane_centre` (m, left positive) is the line that `mean_abs_d_m` is measured from. `record` is
    given each step's state and the steering chosen in it. The reward is that of the state after
    each step.
    """
    memory = OffsetMemory(round(HOLD_S * world.frequency_hz))
    score, ended = 0.0, None
    offsets, speeds = [], []
    start_m = world.state.odometer_m
    for _ in range(steps):
        now = world.state
        steer = controller.update(_observe(now, perceive(world), memory))
        if record is not None:
            record(now, steer)
        pedal, brake = pedals(world.traffic, now, throttle)
        after = world.step(Command(steer=steer, throttle=pedal, brake=brake, gear=GEAR))
        offsets.append(abs(after.to_middle - lane_centre))
        speeds.append(after.speed_kmh)
        ended = ending(after)
        score += step_reward(
            after.angle,
            after.to_middle,
            world.road.half_width,
            ended=ended is not None,
        )
        if ended is not None:
            break
    run_up = round(RUN_UP_S * world.frequency_hz)
    return DriveResult(
        steps=len(offsets),
        steps_asked=steps,
        score=score,
        score_per_step=score / steps,
        laps=max(world.state.lap - 1, 0),
        distance_m=world.state.odometer_m - start_m,
        mean_abs_d_m=float(np.mean(offsets)),
        max_abs_d_m=max(offsets),
        speed_kmh=(min(speeds), max(speeds)),
        cruising_kmh=(min(speeds[run_up:]), max(speeds)) if len(speeds) > run_up else None,
        blind_steps=memory.blind_steps,
        noisy=False,
        ended=ended,
    )


class OffsetMemory:
    """Bridges the steps in which no marking is perceived."""

    def __init__(self, hold_steps: int) -> None:
        self.blind_steps = 0
        self._hold_steps = hold_steps
        self._age = 0
        self._last = 0.0

    def fill(self, offset: float | None) -> float:
        """The offset, the last one for `hold_steps` steps, after that 0: along the road."""
        if offset is not None:
            self._age, self._last = 0, offset
            return offset
        self.blind_steps += 1
        self._age += 1
        return self._last if self._age <= self._hold_steps else 0.0


def pedals(traffic: Traffic, now: CarState, throttle: float) -> tuple[float, float]:
    """(throttle, brake): `throttle` on a free road, less or the brake behind a slower car."""
    leader = traffic.leader(now.s, now.to_middle) if traffic.count else None
    if leader is None:
        return throttle, 0.0
    gap, lead_speed = leader
    wish = idm_acceleration(gap, max(now.vx, 0.0), lead_speed, math.inf)
    open_share = min(max(1.0 + wish / EASE_OFF, 0.0), 1.0)
    return throttle * open_share, min(max(-wish - EASE_OFF, 0.0) / FULL_BRAKING, 1.0)


def _observe(now: CarState, seen: Perceived, memory: OffsetMemory) -> Observation:
    return Observation(
        to_lane_centre=memory.fill(seen.to_lane_centre),
        angle=seen.angle,
        heading=seen.heading,
        vx=now.vx,
        vy=now.vy,
        yaw_rate=now.yaw_rate,
        curvature=seen.curvature,
    )
