"""Worlds without physics, whose states a test chooses, for the tests of the control loop."""

import math
from dataclasses import replace

import numpy as np

from controllers.perception.perceived import Perceived
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.traffic.traffic import Traffic
from simulator.vehicle.state import CarState, Command
from trackfeatures import RoadClass

DT = 0.05


def at_rest(**changes: float) -> CarState:
    state = CarState(
        time_s=0.0, x=0.0, y=0.0, z=0.0, yaw=0.0, pitch=0.0, roll=0.0, vx=10.0, vy=0.0,
        yaw_rate=0.0, s=100.0, to_middle=0.0, angle=0.0, curvature=0.0, rpm=3000.0, gear=1,
        wheel_spin=(0.0, 0.0, 0.0, 0.0), steer=0.0, lap=0, odometer_m=0.0, lap_time_s=0.0,
        collision=None, off_track=False, backwards=False,
    )  # fmt: skip
    return replace(state, **changes)  # type: ignore[arg-type]  # fields are floats and flags


class FakeWorld:
    """Plays back `states` and stores the commands."""

    def __init__(self, *states: CarState, traffic: Traffic | None = None) -> None:
        self.road = Road(find_track("oval"))
        self.frequency_hz = 20
        self.traffic = traffic or Traffic(self.road, 0, np.random.default_rng(0))
        self.commands: list[Command] = []
        self._states = list(states)
        self.state = at_rest()

    def step(self, command: Command) -> CarState:
        self.commands.append(command)
        self.state = self._states.pop(0)
        return self.state


class Straight:
    """A car that drives straight at a slant to a straight road: its offset is known at any time."""

    def __init__(self, angle: float = -0.1, speed: float = 20.0) -> None:
        self.angle, self.speed, self.step = angle, speed, 0

    @property
    def offset(self) -> float:
        return self.speed * math.sin(-self.angle) * self.step * DT

    def perceive(self) -> Perceived:
        return Perceived(self.offset, self.angle, RoadClass.STRAIGHT, 0.0)
