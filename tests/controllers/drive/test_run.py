"""Closed-loop driving on a fake world with known results, and on the simulator."""

import csv
import io
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controllers.drive.closed_loop import (
    COLUMNS,
    DriveLog,
    OffsetMemory,
    run_lap,
    throttle_and_brake,
)
from controllers.drive.config import DriveConfig
from controllers.drive.disturbance import DISTURBANCES, Disturbance
from controllers.drive.run import choose_lane, control_loop, drive, steps_for
from controllers.interface import Observation
from controllers.laws.lqr import WEIGHTS_BRIEFLY_TRAINED, LqrPreview
from controllers.perception.perceived import Perceive, Perceived
from controllers.perception.sources import truth
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.traffic.traffic import Traffic
from simulator.vehicle.state import Command
from simulator.watch import Watcher
from simulator.world.world import World
from tests.controllers.fake_world import FakeWorld, at_rest
from trackfeatures import RoadClass, UserError

HALF_WIDTH = Road(find_track("oval")).half_width


class FunctionController:
    """A controller whose steering is `law` of the observation."""

    def __init__(self, law: Callable[[Observation], float]) -> None:
        self.update = law


def perceiving(offset: float | None = 0.0) -> Callable[[FakeWorld], Perceived]:
    return lambda world: Perceived(offset, 0.0, RoadClass.STRAIGHT)


def test_the_score_is_the_sum_of_the_rewards_after_each_step() -> None:
    world = FakeWorld(
        at_rest(to_middle=0.5, angle=0.1, vx=10.0),
        at_rest(to_middle=-1.0, angle=-0.2, vx=20.0, lap=3),
    )
    result = run_lap(world, FunctionController(lambda observation: 0.25), perceiving(), 2)
    first = math.cos(0.1) - math.sin(0.1) - 0.5 / HALF_WIDTH
    second = math.cos(0.2) - math.sin(0.2) - 1.0 / HALF_WIDTH
    assert result.score == pytest.approx(first + second)
    assert result.score_per_step == pytest.approx((first + second) / 2)
    assert (result.steps, result.ended, result.laps) == (2, None, 2)
    assert result.mean_abs_d_m == pytest.approx(0.75)
    assert result.max_abs_d_m == 1.0
    assert list(result.speed_kmh) == pytest.approx([36.0, 72.0])
    assert result.in_lane_share == 1.0
    assert world.commands == [Command(steer=0.25, throttle=0.2, brake=0.0, gear=1)] * 2


def test_the_share_of_steps_between_the_markings_of_the_lane() -> None:
    # A lane of 4 m with its centre 1 m left of the middle: from -1 to 3 m.
    places = (-1.1, -0.9, 2.9, 3.1)
    world = FakeWorld(*(at_rest(to_middle=place) for place in places))
    law = FunctionController(lambda observation: 0.0)
    result = run_lap(world, law, perceiving(), len(places), lane_centre=1.0)
    assert result.in_lane_share == 0.5


def test_the_cruising_speeds_leave_out_the_first_15_s() -> None:
    speeds = [20.0] * 300 + [10.0, 12.0]
    world = FakeWorld(*(at_rest(vx=speed) for speed in speeds))
    result = run_lap(world, FunctionController(lambda observation: 0.0), perceiving(), len(speeds))
    assert list(result.speed_kmh) == pytest.approx([36.0, 72.0])
    assert result.cruising_kmh == pytest.approx((36.0, 43.2))


@pytest.mark.parametrize(
    ("change", "ended"),
    [
        ({"off_track": True}, "off_track"),
        ({"collision": "wall"}, "off_track"),
        ({"backwards": True}, "backwards"),
        ({"collision": "traffic"}, "collision"),
    ],
)
def test_an_ending_step_scores_minus_two_and_later_steps_zero(
    change: dict[str, float], ended: str
) -> None:
    world = FakeWorld(at_rest(), at_rest(**change), at_rest())
    result = run_lap(world, FunctionController(lambda observation: 0.0), perceiving(), 10)
    assert result.ended == ended
    assert (result.steps, result.steps_asked) == (2, 10)
    assert result.score == pytest.approx(1.0 - 2.0)
    assert result.score_per_step == pytest.approx(-0.1)


def test_the_observation_holds_the_perception_and_the_cars_sensors() -> None:
    observations: list[Observation] = []
    world = FakeWorld(at_rest())
    world.state = at_rest(vx=12.0, vy=0.3, yaw_rate=0.1, to_middle=9.0, angle=9.0)

    def law(observation: Observation) -> float:
        observations.append(observation)
        return 0.0

    run_lap(
        world,
        FunctionController(law),
        lambda world: Perceived(0.7, -0.02, RoadClass.LEFT, 0.01),
        1,
    )
    assert observations == [Observation(0.7, -0.02, RoadClass.LEFT, 12.0, 0.3, 0.1, 0.01)]


def test_a_lost_offset_is_held_for_a_time_then_zero() -> None:
    memory = OffsetMemory(hold_steps=2)
    answers = [memory.fill(offset) for offset in (None, 0.4, None, None, None, 0.1, None)]
    assert answers == [0.0, 0.4, 0.4, 0.4, 0.0, 0.1, 0.1]
    assert memory.blind_steps == 5
    straight_on = FunctionController(lambda observation: 0.0)
    result = run_lap(FakeWorld(*[at_rest()] * 3), straight_on, perceiving(None), 3)
    assert result.blind_steps == 3


def test_throttle_is_eased_and_brake_applied_behind_a_slower_car() -> None:
    road = Road(find_track("oval"))
    traffic = Traffic(road, 1, np.random.default_rng(0), ego_s=0.0)
    s, speed = float(traffic.s[0]), float(traffic.speed[0])

    def behind(gap: float, vx: float) -> tuple[float, float]:
        return throttle_and_brake(traffic, at_rest(s=s - gap - 4.46, vx=vx), 0.2)

    assert behind(200.0, speed) == (0.2, 0.0)
    throttle, brake = behind(5.0, speed + 5.0)
    assert throttle == 0.0
    assert 0.1 < brake <= 1.0
    assert list(behind(2.0, 25.0)) == pytest.approx([0.0, (9.0 - 1.0) / 15.0])
    no_traffic = Traffic(road, 0, np.random.default_rng(0))
    assert throttle_and_brake(no_traffic, at_rest(), 0.3) == (0.3, 0.0)


def test_log_has_the_columns_and_signs_of_the_reference_laps() -> None:
    file = io.StringIO()
    log = DriveLog(file)
    log.write(at_rest(angle=0.125, to_middle=-0.5, lap=2, time_s=1.05), 0.75)
    header, row = file.getvalue().splitlines()
    assert header == "t,s,d,th,v,vx,vy,yr,steer,rpm,lap,x,y,z"
    values = dict(zip(COLUMNS, row.split(","), strict=True))
    assert float(values["th"]) == -0.125  # counter-clockwise, where `angle` is clockwise
    assert (float(values["d"]), float(values["v"]), values["lap"]) == (-0.5, 10.0, "2")
    assert (float(values["t"]), float(values["steer"])) == (1.05, 0.75)


def test_the_default_controller_on_the_true_state_stays_in_the_middle(tmp_path: Path) -> None:
    """15 s from rest, with an initial offset of 0.5 m, through the first bend of the town."""
    log = tmp_path / "drive.csv"
    config = DriveConfig(track="town", steps=300, start_d=0.5, log=log)
    result = drive(config)
    assert (result.steps, result.ended, result.blind_steps) == (300, None, 0)
    assert result.max_abs_d_m <= 0.5 + 1e-6
    rows = list(csv.DictReader(log.open()))
    assert len(rows) == 300
    assert float(rows[0]["d"]) == pytest.approx(0.5, abs=0.01)
    length = find_track("town").length_m
    assert float(rows[0]["s"]) == pytest.approx(length - 25.0, abs=0.1)
    assert float(rows[0]["v"]) == pytest.approx(0.0, abs=0.01)
    assert {row["lap"] for row in rows} == {"0", "1"}
    assert all(abs(float(row["d"])) < 0.1 for row in rows[200:])
    again = drive(replace(config, log=tmp_path / "again.csv"))
    assert again == result
    assert (tmp_path / "again.csv").read_bytes() == log.read_bytes()


@pytest.mark.parametrize(
    "wrong",
    [
        {"drop": 1.5},
        {"latency_ms": 5000.0},
        {"realtime": True, "latency_ms": 50.0},
        {"realtime": True, "drop": 1.5},
    ],
)
def test_a_wrong_option_leaves_the_log_of_an_earlier_drive(
    tmp_path: Path, wrong: dict[str, Any]
) -> None:
    log = tmp_path / "drive.csv"
    log.write_text("an earlier drive\n")
    with pytest.raises(UserError):
        drive(replace(DriveConfig(steps=3), log=log, **wrong))
    assert log.read_text() == "an earlier drive\n"


def test_a_port_in_use_leaves_the_log_of_an_earlier_drive(tmp_path: Path) -> None:
    log = tmp_path / "drive.csv"
    log.write_text("an earlier drive\n")
    with Watcher(port=0) as watcher:
        port = int(watcher.url.rsplit(":", 1)[1])
        with pytest.raises(UserError, match=f"port {port}"):
            drive(DriveConfig(steps=3, log=log, watch=port))
    assert log.read_text() == "an earlier drive\n"


def test_two_lanes_follow_the_target_lane_among_traffic() -> None:
    config = DriveConfig(track="highway", lanes=2, steps=500, target_lane=1, traffic=6, seed=2)
    result = drive(config)
    assert result.ended is None
    assert result.max_abs_d_m < 0.3


def test_truth_measures_the_offset_from_the_target_lane() -> None:
    with World(Road(find_track("oval"), lanes=3)) as world:
        world.reset(seed=0, to_middle=-3.0, angle=0.05)
        measured = truth(-4.0)(world)
    assert measured.to_lane_centre == pytest.approx(1.0, abs=1e-6)
    assert measured.angle == pytest.approx(0.05, abs=1e-6)
    assert (measured.heading, measured.curvature) == (RoadClass.STRAIGHT, 0.0)


def test_lqr_preview_drives_on_a_noisy_perception() -> None:
    """The soft weights keep the car in its lane with the errors of a briefly trained model."""
    rng = np.random.default_rng(3)

    def perceive(world: World) -> Perceived:
        exact = truth(0.0)(world)
        offset = exact.to_lane_centre
        assert offset is not None
        lost = rng.uniform() < 0.1
        noisy = offset + rng.normal(0.0, 0.25)
        return Perceived(
            None if lost else noisy, exact.angle + rng.normal(0.0, 0.025), exact.heading
        )

    with World(Road(find_track("town"))) as world:
        world.reset(seed=0)
        result = run_lap(
            world, LqrPreview(0.05, WEIGHTS_BRIEFLY_TRAINED), perceive, 600, noisy=True
        )
    assert result.ended is None
    assert result.max_abs_d_m < 0.8
    assert result.blind_steps > 20
    assert result.noisy


@pytest.mark.parametrize(("perception", "noisy"), [("truth", False), ("model", True)])
def test_a_drive_on_perception_is_noisy(
    perception: str, noisy: bool, perceive_by: Callable[[Perceive], None]
) -> None:
    perceive_by(truth(0.0))
    result = drive(DriveConfig(perception=perception, steps=3))
    assert result.as_json()["noisy"] is noisy


def test_steps_by_track() -> None:
    assert steps_for(None, "forza", 5784.0) == 6500
    assert steps_for(None, "oval", 1500.0) == 2000
    assert steps_for(7, "forza", 5784.0) == 7
    with pytest.raises(UserError, match="1 or more"):
        steps_for(0, "forza", 5784.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"target_lane": 2}, "target lane 2"),
        ({"target_lane": -1}, "target lane -1"),
        ({"start_d": 99.0}, "off the road"),
        ({"start_d": math.nan}, "off the road"),
        ({"target_lane": 0, "start_d": -2.0, "perception": "model"}, "only the lane"),
    ],
)
def test_an_impossible_lane_or_start_is_refused(changes: dict[str, float], message: str) -> None:
    config = replace(DriveConfig(lanes=2), **changes)  # type: ignore[arg-type]  # as above
    with pytest.raises(UserError, match=message):
        choose_lane(config, Road(find_track("oval"), lanes=2))


def test_choice_of_the_lane_to_follow() -> None:
    road = Road(find_track("oval"), lanes=2)
    assert choose_lane(DriveConfig(lanes=2, target_lane=0), road).start_d == 2.0
    assert choose_lane(DriveConfig(lanes=2, start_d=-1.0), road).centre == -2.0
    assert choose_lane(DriveConfig(lanes=2, start_d=-1.0, target_lane=0), road).centre == 2.0
    single = choose_lane(DriveConfig(), Road(find_track("oval")))
    assert (single.start_d, single.centre) == (0.0, 0.0)


@pytest.mark.parametrize(("lanes", "start"), [(1, 0.0), (2, -2.0), (3, 0.0)])
def test_a_drive_starts_at_the_centre_of_the_lane_that_it_follows(lanes: int, start: float) -> None:
    lane = choose_lane(DriveConfig(lanes=lanes), Road(find_track("oval"), lanes=lanes))
    assert (lane.start_d, lane.centre) == (start, start)


def test_the_result_is_written_as_json() -> None:
    result = run_lap(
        FakeWorld(at_rest()), FunctionController(lambda observation: 0.0), perceiving(), 1
    )
    content = json.loads(json.dumps(result.as_json()))
    named = "steps score score_per_step laps mean_abs_d_m max_abs_d_m speed_kmh ended"
    assert set(named.split()) <= set(content)
    assert content["speed_kmh"] == [pytest.approx(36.0)] * 2
    assert content["cruising_kmh"] is None


@pytest.mark.parametrize(
    ("perception", "disturbance", "delay_s"),
    [
        ("model", Disturbance(), 0.0),
        ("model", DISTURBANCES["none"], 0.0),  # the drives of `controllers compare`
        ("model", DISTURBANCES["delay"], None),
        ("truth", Disturbance(), None),
    ],
)
def test_the_controller_knows_the_delay_of_images_without_disturbance(
    perception: str, disturbance: Disturbance, delay_s: float | None
) -> None:
    loop = control_loop(DriveConfig(perception=perception), disturbance)
    assert (loop.noisy, loop.delay_s) == (perception != "truth", delay_s)
