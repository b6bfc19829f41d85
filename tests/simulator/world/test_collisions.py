"""Collisions with traffic, which is pushed, and with walls, which are not crossed."""

import itertools

import numpy as np
import pytest

from simulator.env.reward import ending
from simulator.track.road import Road
from simulator.traffic.traffic import TRAFFIC_CAR_SIZE
from simulator.traffic.wreck import TRAFFIC_CAR
from simulator.vehicle.car import CarParameters
from simulator.vehicle.state import CarState, Command
from simulator.world.world import World
from tests.simulator.track.track_samples import flat_stadium

pytestmark = pytest.mark.contacts

COAST = Command(gear=0)
FULL_BRAKE = Command(brake=1.0, gear=0)


def stadium(width: float = 12.0, lanes: int = 1, straight: float = 1500.0) -> Road:
    return Road(flat_stadium(straight, width=width), lanes)


def follow(state: CarState, throttle: float) -> Command:
    steer = -0.4 * state.to_middle + 2.0 * state.angle
    return Command(steer=min(max(steer, -1.0), 1.0), throttle=throttle, gear=2)


def drive_into_traffic(world: World, seed: int = 0) -> tuple[CarState, CarState, float]:
    """Rear-end collision on the straight: (state before, state after, other car's speed before)."""
    state = world.reset(seed=seed, s=5.0, speed=28.0)
    for _ in range(40 * world.frequency_hz):
        before, other = state, float(world.traffic.speed[0])
        state = world.step(follow(state, 0.3))  # the engine stays below its limiter
        if state.collision is not None:
            return before, state, other
    raise AssertionError("nobody was hit")


def test_a_rear_end_collision_conserves_momentum() -> None:
    with World(stadium(), traffic=1, frequency_hz=200) as world:
        before, state, other = drive_into_traffic(world)
        assert state.collision == "traffic"
        assert state.curvature == 0.0
        own_mass, other_mass = CarParameters().total_mass, TRAFFIC_CAR.total_mass
        momentum = own_mass * before.speed + other_mass * other
        first = own_mass * state.speed + other_mass * float(world.traffic.speed[0])
        assert first == pytest.approx(momentum, rel=2e-3)
        for _ in range(4):
            state = world.step(COAST)
        both = own_mass * state.speed + other_mass * float(world.traffic.speed[0])
        # The road acts for 20 ms: the other car's brakes take a little, my wheels add a little.
        assert both == pytest.approx(momentum, rel=0.02)
        # Little is left of the closing speed.
        closing = before.speed - other
        assert closing > 5.0
        left = float(world.traffic.speed[0]) - state.speed
        assert 0.0 <= left < 0.3 * closing
        assert state.speed < before.speed - 0.3 * closing
        assert world.traffic.speed[0] > other + 0.3 * closing


def test_a_struck_car_leaves_its_lane_and_comes_to_rest() -> None:
    with World(stadium(), traffic=1) as world:
        drive_into_traffic(world)
        assert world.traffic.struck.tolist() == [True]
        place = world.traffic.poses()[0, :2]
        for _ in range(160):
            world.step(FULL_BRAKE)
        went = world.traffic.poses()[0, :2] - place
        assert np.hypot(*went) > 5.0
        assert world.traffic.speed[0] == 0.0
        resting = world.traffic.poses().tobytes()
        for _ in range(20):
            world.step(FULL_BRAKE)
        assert world.traffic.poses().tobytes() == resting
        # The next episode has no trace of the collision.
        assert not world.reset(seed=1).collision
        assert world.traffic.struck.tolist() == [False]


def test_a_wreck_at_rest_can_be_hit_again() -> None:
    with World(stadium(), traffic=1) as world:
        drive_into_traffic(world)
        for _ in range(160):
            state = world.step(FULL_BRAKE)
        place, hits = world.traffic.poses()[0, :2], 0
        for _ in range(400):
            state = world.step(follow(state, 0.4))
            hits += state.collision == "traffic"
        assert hits > 0
        assert np.hypot(*(world.traffic.poses()[0, :2] - place)) > 0.5


def test_traffic_stops_behind_a_wreck() -> None:
    with World(stadium(straight=200.0), traffic=4) as world:
        world.reset(seed=2)
        drive_into_traffic(world, seed=2)
        for _ in range(1200):
            world.step(FULL_BRAKE)
            length = world.road.track.length_m
            on_lane = np.sort(np.append(world.traffic.s, world.state.s))
            gaps = np.diff(np.append(on_lane, on_lane[0] + length))
            assert (
                gaps.min() > TRAFFIC_CAR_SIZE[0] - 0.3
            )  # two boxes at rest may lean on each other
        assert np.all(world.traffic.speed < 0.1)


@pytest.mark.parametrize("where", ["straight", "bend"])
@pytest.mark.parametrize("side", [1, -1])
def test_no_wall_is_crossed_at_any_speed_or_angle(side: int, where: str) -> None:
    place = 100.0 if where == "straight" else 1530.0
    with World(stadium(width=20.0)) as world:
        for angle, kmh in itertools.product((0.1, 0.3, 0.8, 1.5), (60.0, 150.0, 250.0)):
            state = world.reset(seed=0, s=place, angle=-side * angle, speed=kmh / 3.6)
            for _ in range(60):
                state = world.step(COAST)
                assert abs(state.to_middle) < world.road.wall_offset - 0.8, (angle, kmh)
                assert abs(state.roll) < 0.5
                assert state.z < 0.6


def test_walls_hold_at_a_low_control_rate() -> None:
    with World(stadium(width=20.0), frequency_hz=1) as world:
        state = world.reset(seed=0, s=100.0, angle=-0.8, speed=50.0)
        state = world.step(COAST)
        assert state.collision == "wall"
        assert abs(state.to_middle) < world.road.wall_offset


def test_a_glancing_impact_turns_the_car_along_the_wall() -> None:
    with World(stadium(width=20.0)) as world:
        state = world.reset(seed=0, s=100.0, angle=-0.2, speed=45.0)
        while state.collision is None:
            before = state
            state = world.step(COAST)
        for _ in range(5):
            state = world.step(COAST)
        assert abs(state.angle) < 0.5 * abs(before.angle)
        assert 0.9 * before.speed < state.speed < before.speed - 0.3


def test_a_head_on_impact_removes_nearly_all_speed() -> None:
    with World(stadium(width=20.0)) as world:
        state = world.reset(seed=0, s=100.0, angle=-1.5, speed=20.0)
        while state.collision is None:
            state = world.step(COAST)
        assert abs(state.speed) < 0.3 * 20.0


def test_wall_contact_counts_as_off_track_or_else_as_collision() -> None:
    with World(stadium()) as world:
        state = world.reset(seed=0, s=100.0, angle=-0.5, speed=20.0)
        reasons = []
        while state.collision is None:
            state = world.step(COAST)
            reasons.append((ending(state), ending(state, ("backwards", "collision"))))
        assert ("off_track", None) in reasons
        assert reasons[-1] == ("off_track", "collision")
