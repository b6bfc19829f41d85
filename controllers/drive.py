"""Closed-loop driving: perceive, steer, step, score. Throttle is held open loop, as in the paper.

A run of `run_lap` is a function of the world's reset, the controller and the perception alone.
"""

import math
from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np

from controllers.observation import Controller, Observation
from controllers.perception import Perceived
from controllers.result import DriveResult
from simulator.idm import idm_acceleration
from simulator.reward import ending, step_reward
from simulator.state import CarState, Command
from simulator.track.road import Road
from simulator.traffic import Traffic

GEAR = 1
THROTTLE = 0.2
HOLD_S = 0.5
"""A lost offset is held this long; then the car is steered along the road until one is seen."""
RUN_UP_S = 15.0
EASE_OFF = 1.0  # m/s2 of wanted braking at which the throttle is closed
FULL_BRAKING = 15.0  # m/s2 at full brake on asphalt


class Drivable(Protocol):
    """What a drive needs of `simulator.world.World`."""

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
