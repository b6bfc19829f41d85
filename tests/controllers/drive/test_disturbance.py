"""Disturbances: equal for equal seeds, of the stated size, and with an effect on the car."""

import math

import numpy as np
import pytest

from controllers.drive.config import DriveConfig
from controllers.drive.disturbance import (
    ANGLE_NOISE_RAD,
    DISTURBANCES,
    GUST_M_S,
    OFFSET_NOISE_M,
    Disturbance,
    Gusts,
    NoisySensors,
    find_disturbance,
)
from controllers.drive.run import drive
from controllers.interface import Observation
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.car import CarParameters
from simulator.vehicle.state import Command
from trackfeatures import RoadClass

SEEN = Observation(0.5, 0.1, RoadClass.LEFT, 20.0, 0.0, 0.2, 0.01)


class Listener:
    """A controller that stores its observations."""

    def __init__(self) -> None:
        self.heard: list[Observation] = []

    def update(self, observation: Observation) -> float:
        self.heard.append(observation)
        return 0.0


def test_noise_has_the_stated_size_and_is_the_same_for_every_controller() -> None:
    first, second = Listener(), Listener()
    for listener in (first, second):
        noisy = Disturbance(noise=True).controller(listener, seed=3)
        for _ in range(4000):
            noisy.update(SEEN)
    assert first.heard == second.heard
    offsets = np.array([one.to_lane_centre for one in first.heard]) - SEEN.to_lane_centre
    angles = np.array([one.angle for one in first.heard]) - SEEN.angle
    assert offsets.std() == pytest.approx(OFFSET_NOISE_M, rel=0.05)
    assert angles.std() == pytest.approx(ANGLE_NOISE_RAD, rel=0.05)
    assert abs(offsets.mean()) < 3 * OFFSET_NOISE_M / math.sqrt(4000)
    assert {one.heading for one in first.heard} == {RoadClass.LEFT}
    other = Listener()
    NoisySensors(other, np.random.default_rng([4, 6])).update(SEEN)
    assert other.heard[0] != first.heard[0]


def test_the_car_is_drawn_within_the_stated_ranges() -> None:
    plain = CarParameters()
    assert Disturbance().car(7) == plain
    for seed in range(20):
        friction = DISTURBANCES["friction"].car(seed)
        assert 0.8 <= friction.friction <= 1.6
        # The friction changes, the stiffness of the tyres does not.
        assert friction.cornering_stiffness(True, 1.0) == pytest.approx(
            plain.cornering_stiffness(True, 1.0)
        )
        mass = DISTURBANCES["mass"].car(seed)
        assert 0.8 <= mass.mass / plain.mass <= 1.2
        assert mass.inertia[2] / plain.inertia[2] == pytest.approx(mass.mass / plain.mass)
        stiffness = DISTURBANCES["stiffness"].car(seed).tyre_stiffness / plain.tyre_stiffness
        assert 0.8 <= stiffness <= 1.2
    assert DISTURBANCES["mass"].car(1) == DISTURBANCES["mass"].car(1)
    assert DISTURBANCES["mass"].car(1) != DISTURBANCES["mass"].car(2)


def test_gusts_have_the_stated_size_and_last() -> None:
    gusts = Gusts(0.05, np.random.default_rng(0))
    wind = np.array([gusts.step() for _ in range(40_000)])
    assert wind.std() == pytest.approx(GUST_M_S, rel=0.1)
    assert np.corrcoef(wind[:-30], wind[30:])[0, 1] == pytest.approx(math.exp(-1.0), abs=0.06)


def test_a_side_wind_accelerates_the_car_by_its_force_over_its_mass() -> None:
    """Without steering, the lateral speed gained in a step is the force over the mass."""

    class Steady:
        def step(self) -> float:
            return 10.0

    road = Road(find_track("oval"))
    plain = Disturbance().world(road, traffic=0, frequency_hz=200, seed=0)
    windy = Disturbance(wind=True).world(road, traffic=0, frequency_hz=200, seed=0)
    windy._gusts = Steady()  # type: ignore[attr-defined]
    with plain, windy:
        ends = []
        for world in (plain, windy):
            world.reset(seed=0, s=20.0, speed=20.0)
            ends.append(world.step(Command(gear=0)))
        force = 0.5 * 1.23 * 4.5 * 10.0 * 20.0
        gained = ends[1].vy - ends[0].vy
        # The tyre forces reduce it slightly within the 5 ms.
        assert 0.6 < gained / (force / plain.car.total_mass / 200) <= 1.01


def test_each_disturbance_changes_the_drive_and_only_the_seed_decides() -> None:
    config = DriveConfig(controller="torcs", track="town", steps=200, seed=1)
    drives = {name: drive(config, disturbance=find_disturbance(name)) for name in DISTURBANCES}
    assert drives["none"] == drive(config)
    for name, disturbed in drives.items():
        assert (disturbed == drives["none"]) == (name == "none")
        assert disturbed == drive(config, disturbance=find_disturbance(name))
        assert disturbed.ended is None
