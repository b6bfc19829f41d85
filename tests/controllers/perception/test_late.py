"""Late and lost answers, the prediction over them, and the car that slows down without them."""

import math
from dataclasses import replace

import numpy as np
import pytest

from controllers.drive.closed_loop import LOST_SPEED, run_lap, slow_down
from controllers.drive.config import DriveConfig
from controllers.drive.run import drive
from controllers.laws.lqr import Lqr
from controllers.perception.late import LatePerception, RoadEstimate
from controllers.perception.perceived import Perceived
from controllers.perception.sources import truth
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World
from tests.controllers.fake_world import DT, Straight, at_rest
from trackfeatures import RoadClass, UserError


def late(latency_s: float, drop: float = 0.0, **options: bool) -> LatePerception[Straight]:
    return LatePerception(
        lambda car: car.perceive(),
        lambda car: at_rest(vx=car.speed),
        dt=DT,
        latency_s=latency_s,
        drop=drop,
        rng=np.random.default_rng(0),
        **options,
    )


@pytest.mark.parametrize("latency_s", [0.0, 0.05, 0.12, 0.3])
def test_the_offset_is_predicted_to_the_present(latency_s: float) -> None:
    car, perceive = Straight(), late(latency_s)
    delay = math.ceil(latency_s / DT - 1e-9)
    for car.step in range(20):
        known = perceive(car)
        if car.step < delay:
            assert known.to_lane_centre is None
        else:
            assert known.to_lane_centre == pytest.approx(car.offset, abs=1e-9)
            assert known.angle == pytest.approx(car.angle)
            assert known.lost_s == 0.0


def test_without_prediction_the_answer_is_late() -> None:
    car, perceive = Straight(), late(0.1, predict=False)
    for car.step in range(10):
        known = perceive(car)
    assert known.to_lane_centre == pytest.approx(car.offset - 2 * DT * 20.0 * math.sin(0.1))


def test_an_answer_older_than_the_stored_motion_is_not_fused() -> None:
    road = RoadEstimate(DT)
    answers = {30: 0.0, 32: 1.0}  # each to an image of 30 steps before; 22 steps are stored
    for step in range(33):
        offset = answers.get(step)
        arrived = None
        if offset is not None:
            arrived = Perceived(
                offset, 0.0, RoadClass.STRAIGHT, None, offset_std_m=1.0, angle_std_rad=0.1
            )
        road.update(at_rest(vx=20.0), arrived, 30)
    assert road.present(30).to_lane_centre == pytest.approx(1.0)


def test_the_prediction_ends_a_second_after_the_last_answer() -> None:
    car, perceive = Straight(), late(0.05, drop=0.0)
    for car.step in range(5):
        perceive(car)
    perceive._drop = 1.0  # from now on all answers are lost
    for car.step in range(5, 40):
        known = perceive(car)
        waited = (car.step - 4 - 1) * DT + DT  # the answer of step 4 arrived at step 5
        if car.step == 5:
            assert known.lost_s == 0.0
        elif known.to_lane_centre is not None:
            assert known.to_lane_centre == pytest.approx(car.offset, abs=1e-9)
            assert known.lost_s == pytest.approx(waited - DT)
            assert known.lost_s <= 1.0 + 1e-9
        else:
            assert known.lost_s > 1.0
    assert known.to_lane_centre is None
    assert perceive.lost_answers == 35


def test_the_share_of_lost_answers_is_the_requested_share() -> None:
    perceive, car = late(0.0, drop=0.3), Straight()
    for car.step in range(2000):
        perceive(car)
    assert perceive.lost_answers / 2000 == pytest.approx(0.3, abs=0.04)


@pytest.mark.parametrize(("latency", "drop"), [(-1.0, 0.0), (5.0, 0.0), (0.0, 1.0), (0.0, -0.1)])
def test_values_out_of_range_are_refused(latency: float, drop: float) -> None:
    with pytest.raises(UserError, match="give 0"):
        late(latency, drop)


def test_prediction_compensates_a_delay() -> None:
    """With prediction over 0.15 s the car stays nearer to its lane on a winding road."""
    found = {}
    for predict in (False, True):
        with World(Road(find_track("town"))) as world:
            world.reset(seed=0, to_middle=0.5)
            perceive: LatePerception[World] = LatePerception(
                truth(0.0),
                lambda world: world.state,
                dt=DT,
                latency_s=0.15,
                drop=0.05,
                rng=np.random.default_rng(1),
                predict=predict,
            )
            found[predict] = run_lap(world, Lqr(DT), perceive, 600)
    assert found[True].ended is None
    assert found[True].mean_abs_d_m < 0.6 * found[False].mean_abs_d_m


def test_the_car_slows_down_when_perception_is_lost_and_goes_on_when_it_returns() -> None:
    exact, step = truth(0.0), 0

    def perceive(world: World) -> Perceived:
        nonlocal step
        step += 1
        seen = exact(world)
        return replace(seen, to_lane_centre=None) if 200 < step < 260 else seen

    speeds = []
    with World(Road(find_track("oval"))) as world:
        world.reset(seed=0)
        result = run_lap(
            world, Lqr(DT), perceive, 400, record=lambda now, steer: speeds.append(now.speed)
        )
    # The car slows down after a second, 20 steps.
    assert result.slowed_steps == 259 - 200 - 20
    assert result.blind_steps == 59
    assert speeds[259] < speeds[215] - 1.0
    assert speeds[-1] > speeds[262]


def test_slowing_down_ends_at_5_m_per_s() -> None:
    assert slow_down(20.0, 0.2, 0.0) == (0.0, 0.1)
    assert slow_down(20.0, 0.2, 0.5) == (0.0, 0.5)
    assert slow_down(LOST_SPEED - 0.1, 0.2, 0.0) == (0.2, 0.0)


def test_a_drive_with_latency_and_lost_answers_is_repeatable() -> None:
    config = DriveConfig(controller="lqr", steps=150, latency_ms=50.0, drop=0.05, seed=3)
    result = drive(config)
    assert drive(config) == result
    assert result.ended is None
    assert result != drive(replace(config, latency_ms=0.0, drop=0.0))
