"""Driving at a set speed: the limit in perceived bends, and drives with and without traffic."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from controllers.drive.config import DriveConfig
from controllers.drive.run import drive
from controllers.laws.speed import CornerSpeed, on_perception, on_the_truth
from controllers.perception.perceived import Perceive, Perceived
from controllers.perception.sources import truth
from simulator.driving.speed import LATERAL_ACCELERATION
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import CarState
from simulator.world.world import World
from tests.controllers.fake_world import FakeWorld, at_rest
from trackfeatures import RoadClass

DT = 0.05


def seen(heading: RoadClass) -> Perceived:
    return Perceived(0.0, 0.0, heading)


def test_a_straight_road_has_no_limit() -> None:
    bends = CornerSpeed(DT)
    assert min(bends(at_rest(vx=20.0), seen(RoadClass.STRAIGHT)) for _ in range(50)) > 100.0


def test_an_announced_bend_has_a_radius_of_60_m_until_the_yaw_rate_shows_it() -> None:
    bends, straight = CornerSpeed(DT), at_rest(vx=10.0)
    bends(straight, seen(RoadClass.STRAIGHT))
    limits = [bends(straight, seen(RoadClass.RIGHT)) for _ in range(100)]
    assert limits[0] > 100.0  # a single answer does not brake
    assert limits[10] == pytest.approx((LATERAL_ACCELERATION * 60.0) ** 0.5)
    assert limits[-1] > 100.0  # 5 s without a yaw rate: the bend is gentle
    turning = at_rest(vx=10.0, yaw_rate=-10.0 / 30.0)
    felt = [bends(turning, seen(RoadClass.RIGHT)) for _ in range(100)][-1]
    assert felt == pytest.approx((LATERAL_ACCELERATION * 30.0) ** 0.5, rel=0.01)


def test_a_bend_to_the_other_side_is_a_new_bend() -> None:
    bends, now = CornerSpeed(DT), at_rest(vx=10.0)
    for _ in range(100):
        bends(now, seen(RoadClass.LEFT))
    limits = [bends(now, seen(RoadClass.RIGHT)) for _ in range(20)]
    assert limits[-1] == pytest.approx((LATERAL_ACCELERATION * 60.0) ** 0.5)


def test_pedals_accelerate_below_and_brake_above_the_set_point() -> None:
    world = FakeWorld()
    held = on_perception(15.0, DT)
    throttle, brake, gear = held(at_rest(vx=10.0), world.traffic, seen(RoadClass.STRAIGHT))
    assert (throttle > 0.2, brake, gear) == (True, 0.0, 1)
    throttle, brake, _ = held(at_rest(vx=20.0), world.traffic, seen(RoadClass.STRAIGHT))
    assert throttle == 0.0
    assert brake > 0.1
    uphill = on_perception(10.0, DT)(
        at_rest(vx=10.0, pitch=-0.1), world.traffic, seen(RoadClass.STRAIGHT)
    )
    level = on_perception(10.0, DT)(at_rest(vx=10.0), world.traffic, seen(RoadClass.STRAIGHT))
    assert uphill[0] > level[0] + 0.05


def test_the_error_is_measured_on_free_straights_only() -> None:
    road = Road(find_track("oval"))
    held = on_the_truth(15.0, road, 0.0, DT)
    none = FakeWorld().traffic
    for _ in range(270):  # 13.5 s: a car at rest cannot have reached 15 m/s yet
        held(at_rest(vx=2.0), none, seen(RoadClass.STRAIGHT))
    assert held.mean_error is None
    for _ in range(200):
        held(at_rest(vx=14.5), none, seen(RoadClass.STRAIGHT))
    assert held.mean_error == pytest.approx(0.5)
    bend = on_the_truth(15.0, Road(find_track("town")), 0.0, DT)
    for _ in range(200):
        bend(at_rest(vx=9.0, s=90.0), none, seen(RoadClass.LEFT))
    assert bend.mean_error is None


class Watch:
    """Stores the speed and the lateral acceleration of each step, and the gears."""

    def __init__(self) -> None:
        self.speeds: list[float] = []
        self.side: list[float] = []
        self.gears: set[int] = set()

    def __call__(self, now: CarState, perceived: Perceived, steer: float) -> None:
        self.speeds.append(now.speed)
        self.side.append(abs(now.curvature) * now.speed**2)
        self.gears.add(now.gear)


@pytest.mark.parametrize(("track", "speed"), [("circuit", 15.0), ("highway", 25.0)])
def test_the_speed_is_held_and_bends_are_driven_slower(track: str, speed: float) -> None:
    watch = Watch()
    result = drive(DriveConfig(track=track, speed=speed, steps=1200), observers=[watch])
    assert result.ended is None
    assert result.speed_error_m_s is not None
    assert result.speed_error_m_s < 0.3
    assert max(watch.speeds) < speed + 0.5
    assert max(watch.side) < 1.2 * LATERAL_ACCELERATION
    assert result.max_abs_d_m < 0.3
    assert max(watch.gears) >= 2


def test_the_result_of_a_drive_without_a_free_straight_has_a_null_speed_error() -> None:
    short = DriveConfig(track="highway", speed=25.0, steps=20)
    assert drive(short).as_json()["speed_error_m_s"] is None
    held = drive(replace(short, speed=None)).as_json()
    assert not {"speed_error_m_s", "set_speed"} & set(held)


def test_traffic_is_followed_without_a_collision() -> None:
    watch = Watch()
    config = DriveConfig(track="circuit", speed=25.0, traffic=6, steps=1500, seed=1)
    result = drive(config, observers=[watch])
    assert result.ended is None
    assert max(watch.speeds[800:]) < 62.0 / 3.6 + 2.0  # the highest speed of the traffic


def test_on_perception_the_car_slows_down_in_bends(
    perceive_by: Callable[[Perceive], None],
) -> None:
    """The perception has no curvature, as a model's answer has none."""
    exact = truth(0.0)

    def perceive(world: World) -> Perceived:
        now = exact(world)
        return Perceived(now.to_lane_centre, now.angle, now.heading)

    perceive_by(perceive)
    watch = Watch()
    config = DriveConfig(track="circuit", perception="model", speed=20.0, steps=1500)
    result = drive(config, observers=[watch])
    assert result.ended is None
    assert max(watch.speeds) < 20.5
    assert min(watch.speeds[400:]) < 17.0
    assert max(watch.side) < 2.0 * LATERAL_ACCELERATION
    assert result.max_abs_d_m < 1.5
