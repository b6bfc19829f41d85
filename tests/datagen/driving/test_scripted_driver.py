"""The scripted driver: on the road, on its course, clear of others, and varied enough to learn."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.driving.scripted_driver import ScriptedDriver
from datagen.driving.trajectory import OUTSIDE_M, TRAJECTORIES, make_course, max_offset
from simulator.driving.speed import (
    BRAKING,
    LATERAL_ACCELERATION,
    Pedals,
    speed_profile,
    target_acceleration,
)
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.car import CarParameters
from simulator.vehicle.state import Command
from simulator.world.world import World


@pytest.mark.parametrize("kind", TRAJECTORIES)
@pytest.mark.parametrize("lanes", [1, 2, 3])
def test_a_course_stays_within_reach_and_is_gentle(kind: str, lanes: int) -> None:
    road = Road(find_track("circuit"), lanes)
    course = make_course(kind, road, 3000.0, np.random.default_rng([lanes, 1]))
    assert len(course.offset) >= 3000
    assert np.abs(course.offset).max() <= max_offset(road) + 1e-9
    assert max_offset(road) <= lanes * 2.0 + OUTSIDE_M
    assert np.abs(course.slope).max() < 0.35
    assert np.allclose(np.gradient(course.offset), course.slope)
    offset, slope, _ = course.at(100.5)
    assert offset == pytest.approx(course.offset[100:102].mean())
    assert slope == pytest.approx(course.slope[100:102].mean())


def test_a_course_follows_from_its_seed_alone() -> None:
    road = Road(find_track("circuit"), 2)
    one, same, other = (
        make_course("weave", road, 500.0, np.random.default_rng(seed)).offset for seed in (1, 1, 2)
    )
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
    with pytest.raises(tf.UserError, match="unknown trajectory 'zigzag'"):
        make_course("zigzag", road, 500.0, np.random.default_rng(0))


def test_the_speed_profile_keeps_side_acceleration_and_braking() -> None:
    track = find_track("mountain-pass")
    profile = speed_profile(track, 20.0, innermost_y=0.0)
    s = (np.arange(len(profile.limit)) + 0.5) * profile.cell_m
    speed = np.array([profile.at(at) for at in s])
    curvature = np.abs(track.at(s).curvature)
    assert speed.max() == pytest.approx(20.0)
    assert (speed**2 * curvature).max() <= LATERAL_ACCELERATION + 1e-9
    assert np.diff(speed**2).min() >= -2.0 * BRAKING * profile.cell_m - 1e-9


def test_pedals_balance_drag_and_slope_and_shift_up_once() -> None:
    pedals = Pedals(CarParameters())
    throttle, brake, gear = pedals.press(0.0, 10.0, 0.0, 0.0, 0.05)
    assert 0.0 < throttle < 0.2
    assert (brake, gear) == (0.0, 1)
    assert pedals.press(0.0, 10.0, 0.0, 0.05, 0.05)[0] > throttle
    assert pedals.press(-3.0, 10.0, 0.0, 0.0, 0.05)[1] > 0.1
    assert [pedals.press(0.0, 20.0, 0.0, 0.0, 0.05)[2] for _ in range(5)] == [2] * 5
    assert target_acceleration(10.0, 15.0, follow=-4.0) == -4.0


@pytest.mark.parametrize("speed", [8.0, 12.0, 18.0])
def test_pedals_hold_a_speed_without_trim(speed: float) -> None:
    """Drag, rolling resistance and engine braking are balanced to 0.1 m/s2."""
    pedals = Pedals(CarParameters())
    with World(Road(find_track("oval"))) as world:
        state = world.reset(seed=1, s=50.0, speed=speed)
        for _ in range(100):  # 5 s, on the straight
            throttle, brake, gear = pedals.press(0.0, state.speed, 0.0, 0.0, 0.05)
            state = world.step(Command(0.0, throttle, brake, gear))
        assert state.speed == pytest.approx(speed, abs=0.1 * 5.0)


@pytest.mark.parametrize(
    ("track", "lanes", "traffic", "kind"),
    [
        ("highway", 3, 8, "lane-changes"),
        ("mountain-pass", 1, 6, "yaw-recoveries"),
        ("circuit", 2, 4, "weave"),
        ("town", 3, 8, "offsets"),
        ("coast", 1, 0, "lane"),
    ],
)
def test_a_minute_of_driving_is_on_course_and_clear_of_everything(
    track: str, lanes: int, traffic: int, kind: str
) -> None:
    drive = _drive(Road(find_track(track), lanes), traffic, kind, steps=1200)
    assert drive["bad"].sum() == 0
    assert np.mean(drive["error"]) < 0.25
    assert np.percentile(drive["speed_kmh"], 10) > 15.0
    assert np.max(drive["speed_kmh"]) < 66.0
    assert np.max(np.abs(drive["angle"])) < 0.4


def test_recoveries_come_from_yaw_and_from_offset_disturbances() -> None:
    """Yaw recoveries leave the lane by heading, offset recoveries by place; both return to it."""
    road = Road(find_track("highway"), 2)
    lane, yaw, offset = (
        make_course(kind, road, 4000.0, np.random.default_rng(7))
        for kind in ("lane", "yaw-recoveries", "offset-recoveries")
    )
    aside = np.abs(offset.offset - np.median(offset.offset))
    assert 0.1 < np.mean(aside > 0.9) < 0.4
    straight_on = np.abs(offset.slope[aside > 0.9]) < 0.04
    assert straight_on.mean() > 0.3
    assert np.percentile(np.abs(lane.slope), 99) < 0.08
    assert np.abs(yaw.slope).max() > 0.14 > 1.4 * np.abs(lane.slope).max()
    assert np.median(np.abs(yaw.offset - np.median(yaw.offset))) < 0.5


def test_labels_vary_enough_to_learn_from() -> None:
    drives = [
        _drive(Road(find_track(track), lanes), 3, kind, steps=600, seed=lanes)
        for (track, lanes), kind in zip(
            [
                ("circuit", 1),
                ("forest", 2),
                ("ring-road", 3),
                ("coast", 2),
                ("circuit", 3),
                ("town", 2),
            ],
            TRAJECTORIES,
            strict=True,
        )
    ]
    angle = np.concatenate([drive["angle"] for drive in drives])
    assert 0.03 < angle.std() < 0.09
    in_lane = np.concatenate([drive["in_lane"] for drive in drives])
    on_marking = np.concatenate([drive["on_marking"] for drive in drives])
    assert in_lane.mean() > 0.6
    assert on_marking.mean() > 0.25
    assert ((in_lane | on_marking) == 1).all()


def _drive(
    road: Road, traffic: int, kind: str, steps: int, seed: int = 3
) -> dict[str, NDArray[Any]]:
    course = make_course(kind, road, steps, np.random.default_rng([seed, 5]))
    driver = ScriptedDriver(road, course, 60.0 / 3.6)
    names = ("bad", "angle", "error", "speed_kmh", "in_lane", "on_marking")
    seen: dict[str, list[float]] = {name: [] for name in names}
    driven = 0.0
    with World(road, traffic=traffic) as world:
        state = world.reset(
            seed=seed, s=40.0, to_middle=driver.offset_at(0.0), speed=driver.speed_at(40.0)
        )
        for _ in range(steps):
            state = world.step(driver.command(state, world.traffic, driven))
            driven += state.speed / 20.0
            features = world.features()
            seen["bad"].append(bool(state.collision or state.off_track or state.backwards))
            seen["angle"].append(state.angle)
            seen["error"].append(abs(state.to_middle - (driver._steered_for or 0.0)))
            seen["speed_kmh"].append(state.speed_kmh)
            seen["in_lane"].append(features.ml is not None)
            seen["on_marking"].append(features.m is not None)
    return {name: np.array(values) for name, values in seen.items()}
