"""Closed-loop driving: in each control step the road is perceived, the car is steered and moved,
and the reward is added. SI units, track frame, left positive.

The throttle is constant, as in the paper, unless other `Pedals` are given. The result of `run_lap`
depends only on the reset of the world, the controller, the pedals and the perception.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from operator import attrgetter
from typing import Any, Protocol, TextIO, TypeVar

import numpy as np

from controllers.drive.config import THROTTLE
from controllers.interface import Controller, Observation
from controllers.perception.late import LOST_S
from controllers.perception.perceived import Perceived
from controllers.perception.real_time import RealTimeFigures
from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.env.reward import OFF_TRACK_REWARD, Ending, ending, quadratic_reward, step_reward
from simulator.track.road import Road
from simulator.traffic.idm import idm_acceleration
from simulator.traffic.traffic import Traffic
from simulator.vehicle.state import CarState, Command, speed_of
from trackfeatures.errors import UserError

GEAR = 1
HOLD_S = 0.5
"""Time (s) for which the last perceived offset is used if the perception returns no offset.
Afterwards the offset is taken as 0, so that the car drives along the road."""
RUN_UP_S = 15.0
"""Duration (s) of the standing start, which `DriveResult.cruising_kmh` leaves out."""
EASE_OFF = 1.0  # m/s2 of demanded braking at which the throttle is closed
FULL_BRAKING = 15.0  # deceleration (m/s2) at full brake on asphalt
LOST_SPEED, LOST_BRAKE = 5.0, 0.1
"""When the perception is lost, the car slows down to LOST_SPEED (m/s) with the brake LOST_BRAKE (0
to 1)."""
REWARDS = ("paper", "quadratic")
"""Names of the rewards `step_reward` and `quadratic_reward` of `simulator.env.reward`."""


class Drivable(Protocol):
    """The part of `simulator.world.world.World` that a drive uses."""

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
        """Mean absolute difference (m/s) from the set speed; None for pedals that hold no speed."""

    def __call__(
        self, now: CarState, traffic: Traffic, perceived: Perceived
    ) -> tuple[float, float, int]:
        """Return throttle (0 to 1), brake (0 to 1) and gear for the present control step."""


@dataclass(frozen=True)
class HeldThrottle:
    """The paper's pedals: gear 1 and a constant throttle, reduced behind a slower car."""

    throttle: float = THROTTLE
    mean_error: None = None

    def __call__(
        self, now: CarState, traffic: Traffic, perceived: Perceived
    ) -> tuple[float, float, int]:
        return *throttle_and_brake(traffic, now, self.throttle), GEAR


@dataclass(frozen=True, slots=True)
class DriveResult:
    """The score of a drive, its offsets, speeds and laps, and how it ended."""

    steps: int
    """Control steps driven; fewer than `steps_asked` if the drive ended early."""
    steps_asked: int
    """Control steps requested."""
    score: float
    """Sum of the rewards over `steps_asked` steps. If the drive ended early, its last step counts
    -2 and the steps that were not driven count 0."""
    score_per_step: float
    """`score` divided by `steps_asked`."""
    quadratic_per_step: float
    """Mean of the paper's quadratic reward over `steps_asked` steps. If the drive ended early, its
    last step and the steps that were not driven count -2 each."""
    laps: int
    """Number of complete laps, from one crossing of the start line to the next."""
    distance_m: float
    """Distance driven."""
    mean_abs_d_m: float
    """Mean distance from the centre of the lane to follow."""
    max_abs_d_m: float
    """Largest distance from the centre of the lane to follow."""
    in_lane_share: float
    """Share of the steps with the car's centre between the markings of the lane to follow."""
    speed_kmh: tuple[float, float]
    """Lowest and highest speed, including the standing start."""
    cruising_kmh: tuple[float, float] | None
    """Lowest and highest speed after the first 15 s; None for a shorter drive."""
    blind_steps: int
    """Steps without a perceived offset."""
    slowed_steps: int
    """Steps in which the car slowed down because the perception was lost for more than 1 s."""
    noisy: bool
    """True if the controller received an estimated state with errors, False for the true state."""
    ended: str | None
    """Why the drive ended early: off_track (also by a contact with a wall), backwards, or collision
    (with a car); None for a complete drive."""
    real_time: RealTimeFigures | None = None
    """Times of the answers and steps of a drive with `--realtime`, None for all other drives. In
    JSON they are fields of the result itself."""
    speed_error_m_s: float | None = None
    """Mean absolute difference of the speed from the value of `--speed` on free straights; None
    without `--speed`, or if the road was not free for long enough."""
    set_speed: bool = False
    """True in a drive with `--speed`. JSON then has `speed_error_m_s`; it never has `set_speed`."""

    def per_step(self, reward: str) -> float:
        """Return the mean of the reward called `reward`, paper or quadratic, over the requested
        steps."""
        return self.score_per_step if reward == "paper" else self.quadratic_per_step

    def as_json(self) -> dict[str, Any]:
        """Return the fields as values for JSON."""
        values = asdict(self)
        if not values.pop("set_speed"):
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

    `lane_centre` (m, left positive) is the line from which `mean_abs_d_m` is measured. `noisy`
    tells whether the perception has errors; it is only copied to the result. `record` is called
    with the state and the steering action of each step. The reward of a step is the reward of the
    state after it.
    """
    memory = OffsetMemory(round(HOLD_S * world.frequency_hz))
    start_m, slowed_steps, ended = world.state.odometer_m, 0, None
    rows: list[tuple[float, ...]] = []
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
            slowed_steps += 1
        after = world.step(Command(steer=steer, throttle=throttle, brake=brake, gear=gear))
        rows.append((*AFTER(after), steer))
        ended = ending(after)
        if ended is not None:
            break
    distance = world.state.odometer_m - start_m
    driven = Driven(
        *(np.array(rows), ended, world.state.lap, distance),
        *(memory.blind_steps, slowed_steps, noisy),
    )
    result = driven.result(steps, world.road, lane_centre, world.frequency_hz)
    holds_speed = not isinstance(pedals, HeldThrottle)
    return replace(result, speed_error_m_s=pedals.mean_error, set_speed=holds_speed)


def check_reward(name: str) -> None:
    """Raise UserError unless `name` is "paper" or "quadratic"."""
    if name not in REWARDS:
        raise UserError(f"there is no reward {name!r}; use one of: {', '.join(REWARDS)}")


def throttle_and_brake(traffic: Traffic, now: CarState, throttle: float) -> tuple[float, float]:
    """Return throttle and brake, each 0 to 1. On a free road the throttle is `throttle`; behind a
    slower car it is reduced, or the car brakes."""
    leader = traffic.leader(now.s, now.to_middle) if traffic.count else None
    if leader is None:
        return throttle, 0.0
    gap, lead_speed = leader
    demand = idm_acceleration(gap, max(now.vx, 0.0), lead_speed, math.inf)
    open_share = min(max(1.0 + demand / EASE_OFF, 0.0), 1.0)
    return throttle * open_share, min(max(-demand - EASE_OFF, 0.0) / FULL_BRAKING, 1.0)


def slow_down(speed: float, throttle: float, brake: float) -> tuple[float, float]:
    """Return throttle and brake (0 to 1) that slow the car down to 5 m/s. If `speed` (m/s) is not
    above 5, return `throttle` and `brake` unchanged."""
    if speed > LOST_SPEED:
        return 0.0, max(brake, LOST_BRAKE)
    return throttle, brake


class OffsetMemory:
    """Replaces a missing offset by the last perceived offset, for at most `hold_steps` control
    steps."""

    def __init__(self, hold_steps: int) -> None:
        self.blind_steps = 0
        self._hold_steps = hold_steps
        self.age = 0
        """Steps since the last perceived offset."""
        self._last = 0.0

    def fill(self, offset: float | None) -> float:
        """Return `offset` (m). If it is None, return the last offset in the first `hold_steps`
        steps without an offset, and 0 in later steps."""
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


AFTER = attrgetter("to_middle", "angle", "vx", "vy")


@dataclass
class Driven:
    """The control steps that were driven, and how the drive ended."""

    after: FloatArray
    """(n, 5): to_middle (m), angle (rad), vx and vy (m/s) after each of the n steps, and the
    steering action of the step."""
    ended: Ending | None
    laps_begun: int
    distance_m: float
    blind_steps: int
    slowed_steps: int = 0
    noisy: bool = False

    def result(self, steps: int, road: Road, lane_centre: float, frequency_hz: int) -> DriveResult:
        """Return the result of a drive of which `steps` control steps were requested.

        `lane_centre` is the line to follow, m left of the track's centre.
        """
        driven, ended = len(self.after), self.ended is not None
        offsets = abs(self.after[:, 0] - lane_centre)
        score, quadratic = sum_rewards(self.after, lane_centre, road.half_width, ended)
        speeds = [3.6 * speed_of(vx, vy) for vx, vy in self.after[:, 2:4].tolist()]
        cruising = speeds[round(RUN_UP_S * frequency_hz) :]
        return DriveResult(
            steps=driven,
            steps_asked=steps,
            score=score,
            score_per_step=score / steps,
            quadratic_per_step=(quadratic + OFF_TRACK_REWARD * (steps - driven)) / steps,
            laps=max(self.laps_begun - 1, 0),
            distance_m=self.distance_m,
            mean_abs_d_m=float(np.mean(offsets)),
            max_abs_d_m=float(offsets.max()),
            in_lane_share=int(np.count_nonzero(offsets <= road.lane_width / 2)) / driven,
            speed_kmh=(min(speeds), max(speeds)),
            cruising_kmh=(min(cruising), max(cruising)) if cruising else None,
            blind_steps=self.blind_steps,
            slowed_steps=self.slowed_steps,
            noisy=self.noisy,
            ended=self.ended,
        )


@compiled
def sum_rewards(
    after: FloatArray, lane_centre: float, half_width: float, ended: bool
) -> tuple[float, float]:
    """Return the sums of `step_reward` and `quadratic_reward` over the n steps of a drive.

    `after` (n, 5) has to_middle (m), angle (rad), vx and vy (m/s) after each step, and the steering
    action. `lane_centre` and `half_width` (of the track) are in m. `ended`: whether the last step
    ended the drive.
    """
    score, quadratic = 0.0, 0.0
    for k in range(len(after)):
        end, angle = ended and k == len(after) - 1, after[k, 1]
        score += step_reward(angle, after[k, 0], half_width, end)
        quadratic += quadratic_reward(abs(after[k, 0] - lane_centre), angle, after[k, 4], end)
    return score, quadratic


COLUMNS = ("t", "s", "d", "th", "v", "vx", "vy", "yr", "steer", "rpm", "lap", "x", "y", "z")
"""Columns of a log: t in s, s in m along the track, d in m left of its centre, th (yaw minus track
tangent) in rad, v, vx and vy in m/s, yr in rad/s, steer in [-1, 1], rpm in 1/min, lap (laps begun),
x, y and z in m."""


class DriveLog:
    """CSV log of a drive. A row has the state before a control step, and the steering action of the
    step.

    The columns are `COLUMNS`, as in the logs of the laps recorded in TORCS.
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file
        file.write(",".join(COLUMNS) + "\n")

    def write(self, state: CarState, steer: float) -> None:
        # th is positive counter-clockwise, as in the recorded TORCS laps; `angle` is positive
        # clockwise.
        self._file.write(
            f"{state.time_s:.3f},{state.s:.3f},{state.to_middle:.5f},{-state.angle:.6f},"
            f"{state.speed:.4f},{state.vx:.4f},{state.vy:.4f},{state.yaw_rate:.6f},{steer:.6f},"
            f"{state.rpm:.1f},{state.lap},{state.x:.4f},{state.y:.4f},{state.z:.4f}\n"
        )
