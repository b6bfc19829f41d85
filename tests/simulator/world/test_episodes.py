"""Episodes: bit-identical replay, laps, collisions, leaving the track, bad input."""

import hashlib
import math
import subprocess
import sys
from dataclasses import astuple

import numpy as np
import pytest

import trackfeatures as tf
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import CarState, Command, World
from tests.simulator.track.track_samples import flat_stadium
from trackfeatures.errors import UserError


def stadium(lanes: int = 2) -> Road:
    return Road(flat_stadium(300.0), lanes)


def follow(state: CarState, throttle: float = 0.2, target: float = 0.0) -> Command:
    """The steering law of the TORCS drives."""
    th, d = -state.angle, state.to_middle - target
    wheel = -(d + 0.1 * (state.vy + state.vx * math.sin(th)) + 2.0 * th + 0.1 * state.yaw_rate)
    return Command(steer=min(max(wheel / 0.36652, -1.0), 1.0), throttle=throttle)


def fingerprint(seed: int, *, rehearse: bool) -> str:
    """Hash of all states and traffic poses of one eventful episode."""
    digest = hashlib.sha256()
    with World(stadium(), traffic=4) as world:
        if rehearse:  # an episode before, with crashes: nothing of it may be left
            world.reset(seed=99, s=20.0, speed=25.0, angle=-0.4)
            for _ in range(60):
                world.step(Command(steer=-1.0, throttle=1.0))
        state = world.reset(seed=seed, to_middle=-2.0)
        for step in range(400):
            digest.update(repr(astuple(state)).encode() + world.traffic.poses().tobytes())
            # Fast enough to hit the traffic, then the wall.
            command = follow(state, 0.5, -2.0) if step < 330 else Command(steer=1.0, throttle=1.0)
            state = world.step(command)
    return digest.hexdigest()


@pytest.mark.contacts
def test_the_same_seed_in_two_processes_is_bit_identical() -> None:
    here = fingerprint(5, rehearse=True)
    assert fingerprint(6, rehearse=False) != here
    code = (
        "import tests.simulator.world.test_episodes as t; print(t.fingerprint(5, rehearse=False))"
    )
    there = [
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout.strip()
        for _ in range(2)
    ]
    assert there == [here, here]


def test_the_start_is_25_m_before_the_line_and_crossing_it_adds_a_lap() -> None:
    with World(stadium()) as world:
        length = world.road.track.length_m
        state = world.reset(seed=0)
        assert state.s == pytest.approx(length - 25.0, abs=1e-6)
        assert (state.lap, state.speed, state.time_s) == (0, 0.0, 0.0)
        while state.lap == 0 and state.time_s < 20.0:
            state = world.step(follow(state))
        assert (state.lap, state.lap_time_s) == (1, 0.0)
        assert 0.0 <= state.s < 1.0
        crossed = state.time_s
        while state.lap == 1 and state.time_s < 120.0:
            assert state.lap_time_s == pytest.approx(state.time_s - crossed, abs=1e-9)
            state = world.step(follow(state))
        assert state.lap == 2
        assert state.odometer_m == pytest.approx(length + 25.0, rel=0.01)


def test_reset_places_the_car_as_asked() -> None:
    with World(stadium()) as world:
        state = world.reset(seed=1, s=360.0, to_middle=1.5, angle=0.2, speed=12.0)
        assert (state.s, state.to_middle) == pytest.approx((360.0, 1.5), abs=1e-6)
        assert (state.angle, state.vx, state.vy) == pytest.approx((0.2, 12.0, 0.0), abs=1e-6)
        assert state.curvature == pytest.approx(1 / 40.0)
        tangent = world.road.track.heading(360.0)
        assert math.cos(tangent - state.yaw) == pytest.approx(math.cos(0.2))
        # angle > 0 points to the right of the track, so driving on moves the car to the right.
        moved = world.step(Command(gear=0))
        assert moved.to_middle < 1.5
        x, y, z, roll, pitch, yaw = world.body_pose()
        assert (x, y, z, yaw) == (moved.x, moved.y, moved.z, moved.yaw)
        assert (roll, pitch) == (moved.roll, moved.pitch)


def test_features_match_the_cars_position() -> None:
    with World(stadium()) as world:
        world.reset(seed=0, s=100.0, to_middle=1.0, angle=0.1)
        features = world.features()
        assert features.angle == pytest.approx(0.1)
        # Two lanes of 4 m: 1 m left of the middle the car is in the left lane.
        assert features.ml == pytest.approx(-3.0, abs=1e-6)
        assert features.mr == pytest.approx(1.0, abs=1e-6)


@pytest.mark.contacts
def test_a_wall_stops_the_car_and_is_recorded() -> None:
    with World(stadium()) as world:
        state = world.reset(seed=0, s=100.0, angle=-0.5, speed=20.0)
        hits = []
        for _ in range(40):
            state = world.step(Command(gear=0))
            hits.append(state.collision)
            assert state.to_middle < world.road.wall_offset
        assert "wall" in hits
        assert hits[0] is None
        assert state.speed < 17.0
        assert math.isfinite(state.roll)
        assert abs(state.roll) < 0.3


@pytest.mark.contacts
def test_a_car_has_left_the_track_before_it_meets_the_wall() -> None:
    with World(stadium()) as world:
        for angle in (-0.1, -0.7, -1.4):
            world.reset(seed=0, s=100.0, to_middle=2.0, angle=angle, speed=15.0)
            seen = [world.step(Command(gear=0)) for _ in range(120)]
            off = next(i for i, state in enumerate(seen) if state.off_track)
            hits = [i for i, state in enumerate(seen) if state.collision]
            assert not hits or off <= hits[0]  # both may integrate into one control step
            assert world.road.edge < seen[off].to_middle < world.road.edge + 0.8


@pytest.mark.contacts
def test_a_collision_with_traffic_is_recorded_and_slows_the_car() -> None:
    with World(stadium(lanes=1), traffic=1) as world:
        world.reset(seed=3)
        gap_s = float(world.traffic.s[0]) - 30.0
        # Traffic starts clear of the ego car, so the ego car starts behind its later place.
        state = world.reset(seed=3, s=gap_s - 60.0, speed=0.0)
        before, hit = state, None
        for _ in range(1200):
            after = world.step(follow(state, 0.45))
            before, state = state, after
            if state.collision is not None:
                hit = state
                break
        assert hit is not None
        assert hit.collision == "traffic"
        assert hit.speed < before.speed - 0.5


def test_driving_backwards_is_reported() -> None:
    with World(stadium()) as world:
        assert not world.reset(seed=0, s=50.0, angle=1.5).backwards
        assert world.reset(seed=0, s=50.0, angle=1.6).backwards
        assert world.reset(seed=0, s=50.0, speed=-1.0).backwards


def test_a_closed_world_raises() -> None:
    world = World(stadium())
    world.reset(seed=0)
    world.close()
    world.close()  # twice is no mistake
    with pytest.raises(UserError, match="closed"):
        world.reset(seed=0)
    with pytest.raises(UserError, match="call reset"):
        world.step(Command())


def test_every_control_rate_gives_the_same_drive() -> None:
    ends = []
    for frequency in (20, 40, 200):
        with World(stadium(), frequency_hz=frequency) as world:
            state = world.reset(seed=0, s=50.0, speed=15.0)
            for _ in range(2 * frequency):
                state = world.step(Command(steer=0.02, throttle=0.2))
            ends.append((state.time_s, state.x, state.y, state.yaw, state.rpm))
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[0], ends[2])


@pytest.mark.parametrize("to_middle", [-2.9, 0.1, 2.7])
def test_distances_on_a_bank_are_measured_from_the_foot_of_the_centre_of_gravity(
    to_middle: float,
) -> None:
    """The foot is found by brute force: the nearest of many points on the road plane."""
    road = Road(find_track("oval"), lanes=3)
    track = road.track
    banks = [abs(float(track.at(s, 1.0).z - track.at(s, -1.0).z)) for s in range(0, 1000, 10)]
    s = 10.0 * int(np.argmax(banks))
    with World(road) as world:
        now = world.reset(seed=1, s=s, to_middle=to_middle)
        places = np.linspace(to_middle - 0.2, to_middle + 0.2, 40_001)
        points = track.at(now.s, places)
        gaps = np.hypot(np.hypot(points.x - now.x, points.y - now.y), points.z - now.z)
        foot = float(places[np.argmin(gaps)])
        assert foot == pytest.approx(to_middle, abs=1e-3)  # the car is placed upright on the bank
        assert abs(foot - now.to_middle) > 0.03
        expected = tf.measure(foot, 0.0, 0.0, 0.0, 3, road.lane_width).distances
        for name, distance in world.features().distances.items():
            assert distance == pytest.approx(expected[name], abs=1e-3)
