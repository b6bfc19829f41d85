"""Closed-loop driving: perceive, steer, step, score. SI units, track frame, left positive.

Throttle is held open loop, as in the paper, unless other `Pedals` are given. A run of `run_lap`
depends on the world's reset, the controller, the pedals and the perception alone.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol, TextIO, TypeVar

import numpy as np

from controllers.drive.config import THROTTLE
from controllers.interface import Controller, Observation
from controllers.perception.perceived import Perceived
from controllers.perception.real_time import RealTimeFigures
from simulator.env.reward import OFF_TRACK_REWARD, ending, quadratic_reward, step_reward
from simulator.track.road import Road
from simulator.traffic.idm import idm_acceleration
from simulator.traffic.traffic import Traffic
from simulator.vehicle.state import CarState, Command
from trackfeatures.errors import UserError

GEAR = 1
HOLD_S = 0.5
"""A lost offset is held this long; after that the car is steered along the road."""
RUN_UP_S = 15.0
"""The standing start, left out of `cruising_kmh`."""
EASE_OFF = 1.0  # m/s2 of wanted braking at which the throttle is closed
FULL_BRAKING = 15.0  # m/s2 at full brake on asphalt
LOST_S = 1.0
"""Without a perceived offset for this long the car slows down ..."""
LOST_SPEED = 5.0  # m/s, ... to this speed, at which it goes on
LOST_BRAKE = 0.1
REWARDS = ("paper", "quadratic")
"""`step_reward` and `quadratic_reward` of `simulator.env.reward`."""


class Drivable(Protocol):
    """What a drive needs of `simulator.world.world.World`."""

    road: Road
    frequency_hz: int
    traffic: Traffic

    @property
    def state(self) -> CarState: ...

    def step(self, command: Command) -> CarState: ...


World = TypeVar("World", bound=Drivable)


class Pedals(Protocol):
    """Throttle, brake and gear of a drive."""

    @property
    def mean_error(self) -> float | None:
        """m/s from the set-point; None where there is none."""
        ...

    def __call__(
        self, now: CarState, traffic: Traffic, perceived: Perceived
    ) -> tuple[float, float, int]: ...


@dataclass(frozen=True)
class HeldThrottle:
    """The paper's: gear 1 and a throttle, less behind a slower car."""

    throttle: float = THROTTLE
    mean_error: None = None

    def __call__(
        self, now: CarState, traffic: Traffic, perceived: Perceived
    ) -> tuple[float, float, int]:
        return *throttle_and_brake(traffic, now, self.throttle), GEAR


@dataclass(frozen=True, slots=True)
class DriveResult:
    """The score of a drive and the figures that belong beside it."""

    steps: int
    """Control steps driven: those requested, unless the drive ended early."""
    steps_asked: int
    score: float
    """Sum of the reward over the steps requested; an ending step gives -2, those after it 0."""
    score_per_step: float
    """`score` over `steps_asked`."""
    quadratic_per_step: float
    """The paper's quadratic reward over `steps_asked`; an ending step and those after it: -2."""
    laps: int
    """Complete laps, from one crossing of the line to the next."""
    distance_m: float
    """Distance driven."""
    mean_abs_d_m: float
    """Mean distance from the centre of the lane to follow."""
    max_abs_d_m: float
    in_lane_share: float
    """Share of the steps with the car's centre between the markings of the lane to follow."""
    speed_kmh: tuple[float, float]
    """Slowest and fastest, the standing start included."""
    cruising_kmh: tuple[float, float] | None
    """The same without the first 15 s; None for a shorter drive."""
    blind_steps: int
    """Steps without a perceived offset."""
    slowed_steps: int
    """Steps in which the car slowed down because perception was lost for more than 1 s."""
    noisy: bool
    """Whether the controller received an estimated state, with errors, instead of the true one."""
    ended: str | None
    """Why it ended early: off_track (or touching a wall), backwards, or collision (with a car)."""
    real_time: RealTimeFigures | None = None
    """Of a drive on the wall clock only; in JSON its fields are those of the result."""
    speed_error_m_s: float | None = None
    """Mean distance from the set-point of `--speed` on free straights; only there in JSON."""

    def per_step(self, reward: str) -> float:
        """The mean over `steps_asked` of a reward of `REWARDS`."""
        return self.score_per_step if reward == "paper" else self.quadratic_per_step

    def as_json(self) -> dict[str, Any]:
        """The fields as JSON values."""
        values = asdict(self)
        if self.speed_error_m_s is None:
            del values["speed_error_m_s"]
        values["speed_kmh"] = list(self.speed_kmh)
        if self.cruising_kmh is not None:
            values["cruising_kmh"] = list(self.cruising_kmh)
        return values | (values.pop("real_time") or {})


def run_lap(
    world: World,
    controller: Controller,
    perceive: Callable[[World], Perceived],
    steps: int,
    *,
    pedals: Pedals = HeldThrottle(),
    lane_centre: float = 0.0,
    noisy: bool = False,
    record: Callable[[CarState, float], None] | None = None,
) -> DriveResult:
    """Drive `steps` control steps from the world's present state, or until the episode ends.

    `lane_centre` (m, left positive) is the line that `mean_abs_d_m` is measured from; `noisy` marks
    a perception with errors in the result. `record` is called with each step's state and steering
    action. The reward is that of the state after each step.
    """
    memory = OffsetMemory(round(HOLD_S * world.frequency_hz))
    totals = _Totals(start_m=world.state.odometer_m)
    for _ in range(steps):
        now = world.state
        perceived = perceive(world)
        steer = controller.update(_observe(now, perceived, memory))
        if record is not None:
            record(now, steer)
        throttle, brake, gear = pedals(now, world.traffic, perceived)
        lost_s = max(perceived.lost_s, memory.age / world.frequency_hz)
        if lost_s > LOST_S:
            throttle, brake = slow_down(now.vx, throttle, brake)
            totals.slowed_steps += 1
        after = world.step(Command(steer=steer, throttle=throttle, brake=brake, gear=gear))
        totals.add(after, steer, lane_centre, world.road)
        if totals.ended is not None:
            break
    run_up = round(RUN_UP_S * world.frequency_hz)
    result = totals.result(world.state, steps, run_up, memory.blind_steps, noisy=noisy)
    return replace(result, speed_error_m_s=pedals.mean_error)


def check_reward(name: str) -> None:
    """Raise UserError unless `name` is one of `REWARDS`."""
    if name not in REWARDS:
        raise UserError(f"there is no reward {name!r}; use one of: {', '.join(REWARDS)}")


def throttle_and_brake(traffic: Traffic, now: CarState, throttle: float) -> tuple[float, float]:
    """`throttle` and no brake on a free road; less throttle or the brake behind a slower car."""
    leader = traffic.leader(now.s, now.to_middle) if traffic.count else None
    if leader is None:
        return throttle, 0.0
    gap, lead_speed = leader
    wanted = idm_acceleration(gap, max(now.vx, 0.0), lead_speed, math.inf)
    open_share = min(max(1.0 + wanted / EASE_OFF, 0.0), 1.0)
    return throttle * open_share, min(max(-wanted - EASE_OFF, 0.0) / FULL_BRAKING, 1.0)


def slow_down(speed: float, throttle: float, brake: float) -> tuple[float, float]:
    """Throttle and brake that slow the car to `LOST_SPEED`, from those of the drive."""
    if speed > LOST_SPEED:
        return 0.0, max(brake, LOST_BRAKE)
    return throttle, brake


class OffsetMemory:
    """Replaces the offset in steps in which no marking is perceived."""

    def __init__(self, hold_steps: int) -> None:
        self.blind_steps = 0
        self._hold_steps = hold_steps
        self.age = 0
        """Steps since the last perceived offset."""
        self._last = 0.0

    def fill(self, offset: float | None) -> float:
        """The offset; while it is None the last one for `hold_steps` steps, after that 0."""
        if offset is not None:
            self.age, self._last = 0, offset
            return offset
        self.blind_steps += 1
        self.age += 1
        return self._last if self.age <= self._hold_steps else 0.0


def _observe(now: CarState, perceived: Perceived, memory: OffsetMemory) -> Observation:
    return Observation(
        to_lane_centre=memory.fill(perceived.to_lane_centre),
        angle=perceived.angle,
        heading=perceived.heading,
        vx=now.vx,
        vy=now.vy,
        yaw_rate=now.yaw_rate,
        curvature=perceived.curvature,
    )


@dataclass
class _Totals:
    """Running sums of a drive, one `add` a control step."""

    start_m: float
    score: float = 0.0
    quadratic: float = 0.0
    ended: str | None = None
    slowed_steps: int = 0
    in_lane_steps: int = 0
    offsets_m: list[float] = field(default_factory=list)
    speeds_kmh: list[float] = field(default_factory=list)

    def add(self, after: CarState, steer: float, lane_centre: float, road: Road) -> None:
        self.offsets_m.append(abs(after.to_middle - lane_centre))
        self.in_lane_steps += self.offsets_m[-1] <= road.lane_width / 2
        self.speeds_kmh.append(after.speed_kmh)
        self.ended = ending(after)
        ended = self.ended is not None
        self.score += step_reward(after.angle, after.to_middle, road.half_width, ended)
        self.quadratic += quadratic_reward(self.offsets_m[-1], after.angle, steer, ended)

    def result(
        self, last: CarState, steps: int, run_up: int, blind_steps: int, *, noisy: bool
    ) -> DriveResult:
        speeds = self.speeds_kmh
        cruising = speeds[run_up:]
        missing = steps - len(speeds)
        return DriveResult(
            steps=len(speeds),
            steps_asked=steps,
            score=self.score,
            score_per_step=self.score / steps,
            quadratic_per_step=(self.quadratic + OFF_TRACK_REWARD * missing) / steps,
            laps=max(last.lap - 1, 0),
            distance_m=last.odometer_m - self.start_m,
            mean_abs_d_m=float(np.mean(self.offsets_m)),
            max_abs_d_m=max(self.offsets_m),
            in_lane_share=self.in_lane_steps / len(speeds),
            speed_kmh=(min(speeds), max(speeds)),
            cruising_kmh=(min(cruising), max(cruising)) if cruising else None,
            blind_steps=blind_steps,
            slowed_steps=self.slowed_steps,
            noisy=noisy,
            ended=self.ended,
        )


COLUMNS = ("t", "s", "d", "th", "v", "vx", "vy", "yr", "steer", "rpm", "lap", "x", "y", "z")
"""Of a log: s; m along the track; m left of its centre; rad, yaw minus tangent; m/s; rad/s;
steering action in [-1, 1]; 1/min; laps begun; m."""


class DriveLog:
    """CSV log with the columns of the reference laps of the real TORCS, one row a control step.

    A row is the state the controller received and its steering action. Each row is complete when
    `write` returns.
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file
        file.write(",".join(COLUMNS) + "\n")

    def write(self, state: CarState, steer: float) -> None:
        # theta is counter-clockwise in the reference laps, `angle` is clockwise.
        self._file.write(
            f"{state.time_s:.3f},{state.s:.3f},{state.to_middle:.5f},{-state.angle:.6f},"
            f"{state.speed:.4f},{state.vx:.4f},{state.vy:.4f},{state.yaw_rate:.6f},{steer:.6f},"
            f"{state.rpm:.1f},{state.lap},{state.x:.4f},{state.y:.4f},{state.z:.4f}\n"
        )
