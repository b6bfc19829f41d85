"""The built-in driver keeps its lane and its distance to a leader, and slows down for bends."""

import pytest

import trackfeatures as tf
from simulator.driving.cruise import Cruise
from simulator.env.reward import ending
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World


@pytest.mark.parametrize("name", ["town", "mountain-pass"])
def test_a_lap_stays_in_the_lane(name: str) -> None:
    road = Road(find_track(name))
    driver = Cruise(road)
    speeds: list[float] = []
    with World(road) as world:
        state = world.reset(seed=1)
        while state.lap < 2:
            state = world.step(driver.command(state, world.traffic))
            assert ending(state) is None
            assert abs(state.to_middle) < 0.35
            speeds.append(state.speed_kmh)
            assert len(speeds) < 8000
    assert 50.0 < max(speeds) < 63.0
    assert min(speeds[200:]) < 45.0  # bends of 30 m radius


def test_follows_traffic_in_each_lane_without_collision() -> None:
    road = Road(find_track("highway"), 3)
    for lane in range(3):
        driver = Cruise(road, speed_kmh=75.0)
        with World(road, traffic=12) as world:
            wanted = tf.lane_centre(lane, 3, road.lane_width)
            state = world.reset(seed=2, to_middle=wanted + 0.8, speed=15.0)
            for _ in range(1200):
                state = world.step(driver.command(state, world.traffic))
                assert ending(state) is None
                if state.time_s > 5.0:
                    assert state.to_middle == pytest.approx(wanted, abs=0.3)
            assert state.speed_kmh < 66.0  # no traffic car drives faster than 62


def test_take_over_keeps_the_cars_present_lane() -> None:
    road = Road(find_track("oval"), 2)
    driver = Cruise(road)
    with World(road) as world:
        state = world.reset(seed=1, s=100.0, to_middle=2.0, speed=15.0)
        for _ in range(20):
            state = world.step(driver.command(state, world.traffic))
        state = world.reset(seed=1, s=100.0, to_middle=-1.2, speed=15.0)
        driver.take_over()
        for _ in range(200):
            state = world.step(driver.command(state, world.traffic))
        assert state.to_middle == pytest.approx(-2.0, abs=0.2)


def test_a_leader_far_ahead_does_not_reduce_the_speed() -> None:
    """Regression: a driver that ignored engine braking drove at 37 km/h, 300 m behind a leader."""
    road = Road(find_track("highway"), 2)
    driver = Cruise(road)
    with World(road, traffic=6) as world:
        state = world.reset(seed=1, to_middle=-2.0)
        for _ in range(500):
            state = world.step(driver.command(state, world.traffic))
        leader = world.traffic.leader(state.s, state.to_middle)
    assert leader is not None
    assert leader[0] > 100.0
    assert state.speed_kmh == pytest.approx(58.5, abs=2.0)
