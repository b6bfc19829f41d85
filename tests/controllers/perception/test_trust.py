"""The Kalman gains for answers with a standard deviation, and drives on them."""

from dataclasses import replace

import numpy as np
import pytest

from controllers.drive.closed_loop import run_lap
from controllers.laws.lqr import Lqr
from controllers.perception.late import LatePerception, RoadEstimate, TrustedPerception
from controllers.perception.perceived import Perceived
from controllers.perception.sources import truth
from controllers.perception.trust import (
    ANGLE_NOISE_RAD,
    OFFSET_NOISE_M,
    ORDINARY_M,
    ORDINARY_RAD,
    UNFAMILIAR_SCALE,
    Trust,
)
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World
from tests.controllers.fake_world import DT, Straight, at_rest
from trackfeatures import RoadClass


def answer(
    offset: float | None = 0.0,
    angle: float = 0.0,
    *,
    std: float = 0.05,
    angle_std: float = 0.01,
    unfamiliar: bool = False,
) -> Perceived:
    return Perceived(
        offset,
        angle,
        RoadClass.STRAIGHT,
        offset_std_m=std,
        angle_std_rad=angle_std,
        out_of_distribution=unfamiliar,
    )


def corrected(second: Perceived, *, steps: int = 1, moved_m: float = 0.0) -> Perceived:
    """The estimate after a first answer of 0 m and 0 rad and `second`."""
    trust = Trust()
    known = trust.correct(None, answer(), 0, 0.0)
    assert known == answer()
    return trust.correct(known, second, steps, moved_m)


def test_an_ordinary_answer_replaces_the_estimate() -> None:
    ordinary = answer(1.0, 0.1, std=ORDINARY_M, angle_std=ORDINARY_RAD)
    assert corrected(ordinary) is ordinary


def test_an_uncertain_answer_has_the_gain_of_a_kalman_filter() -> None:
    found = corrected(answer(1.0, 0.1, std=0.5, angle_std=0.05))
    prior = 0.05**2 + OFFSET_NOISE_M**2
    assert found.to_lane_centre == pytest.approx(prior / (prior + 0.5**2 - ORDINARY_M**2))
    prior = 0.01**2 + ANGLE_NOISE_RAD**2
    assert found.angle == pytest.approx(0.1 * prior / (prior + 0.05**2 - ORDINARY_RAD**2))


def test_uncertainty_lowers_the_gain_and_the_distance_driven_raises_it() -> None:
    def moved(std: float, *, unfamiliar: bool = False, **way: float) -> float:
        second = answer(1.0, std=std, unfamiliar=unfamiliar)
        offset = corrected(
            second, steps=int(way.get("steps", 1)), moved_m=way.get("moved_m", 0.0)
        ).to_lane_centre
        assert offset is not None
        return offset

    assert moved(2.0) < 0.01 < moved(0.5) < moved(0.15) < moved(0.1) == 1.0
    assert moved(0.2, unfamiliar=True) == pytest.approx(moved(0.2 * UNFAMILIAR_SCALE))
    assert moved(0.5, steps=10) > 1.3 * moved(0.5, steps=1)
    assert moved(0.5, moved_m=10.0) > moved(0.5)


def test_the_variance_settles_where_growth_and_correction_are_equal() -> None:
    trust = Trust()
    known = trust.correct(None, answer(), 0, 0.0)
    for _ in range(400):
        known = trust.correct(known, answer(1.0, std=0.3), 1, 0.0)
    variance, q, r = trust.offset_m2, OFFSET_NOISE_M**2, 0.3**2
    gain = (variance + q) / (variance + q + r - ORDINARY_M**2)
    assert (1.0 - gain) ** 2 * (variance + q) + gain**2 * r == pytest.approx(variance)
    assert known.to_lane_centre == pytest.approx(1.0, abs=1e-3)


def test_answers_that_are_not_trusted_count_as_lost() -> None:
    estimate = RoadEstimate(DT)
    wild = answer(5.0, std=5.0, unfamiliar=True)
    for step in range(40):
        estimate.update(at_rest(vx=10.0), wild if step >= 10 else answer(0.1), 0)
        known = estimate.present(0)
        assert known.lost_s == pytest.approx(max(step - 9, 0) * DT)
        assert known.to_lane_centre == pytest.approx(0.1, abs=0.2)
    estimate.update(at_rest(vx=10.0), answer(0.2), 0)
    assert estimate.present(0) == replace(answer(0.2), lost_s=0.0)


def test_an_answer_without_standard_deviation_is_unchanged() -> None:
    trust = Trust()
    exact = Perceived(0.7, 0.1, RoadClass.LEFT, 0.01)
    assert trust.correct(answer(), exact, 1, 1.0) is exact
    perceive = TrustedPerception[World](lambda world: exact, lambda world: at_rest(vx=20.0), dt=DT)
    with World(Road(find_track("oval"))) as world:
        assert all(perceive(world) is exact for _ in range(3))


def test_an_uncertain_outlier_hardly_moves_the_estimate_and_a_blind_answer_stays_blind() -> None:
    car = Straight()

    def perceive(car: Straight) -> Perceived:
        exact = replace(answer(), to_lane_centre=car.offset, angle=car.angle)
        if car.step == 10:
            return replace(exact, to_lane_centre=None)
        if car.step == 20:
            return answer(car.offset + 2.0, car.angle + 0.2, std=1.0, angle_std=0.2)
        return exact

    trusted = TrustedPerception(perceive, lambda car: at_rest(vx=car.speed), dt=DT)
    late = LatePerception(
        perceive,
        lambda car: at_rest(vx=car.speed),
        dt=DT,
        latency_s=0.1,
        drop=0.0,
        rng=np.random.default_rng(0),
    )
    for car.step in range(40):
        known, known_late = trusted(car), late(car)
        if car.step == 10:
            assert known.to_lane_centre is None
        else:
            assert known.to_lane_centre == pytest.approx(car.offset, abs=0.01)
            assert known.angle == pytest.approx(car.angle, abs=0.003)
        if car.step > 2:
            assert known_late.to_lane_centre == pytest.approx(car.offset, abs=0.01)


def test_after_a_long_loss_the_first_answer_replaces_the_estimate() -> None:
    estimate = RoadEstimate(DT)
    for step in range(60):
        first = answer(0.5) if step == 0 else answer(-0.5, std=0.3) if step == 50 else None
        estimate.update(at_rest(vx=20.0), first, 0)
        if step == 50:
            assert estimate.present(0).to_lane_centre == -0.5


def test_less_weight_on_uncertain_answers_keeps_the_car_nearer_to_its_lane() -> None:
    """One answer in five has a large error and a large standard deviation."""
    found = {}
    for trusted in (False, True):
        rng = np.random.default_rng(5)

        def perceive(world: World, rng: np.random.Generator = rng) -> Perceived:
            seen = truth(0.0)(world)
            std = 0.6 if rng.random() < 0.2 else 0.03
            offset, angle = rng.normal(0.0, (std, std / 6.0)).tolist()
            assert seen.to_lane_centre is not None
            return replace(
                seen,
                to_lane_centre=seen.to_lane_centre + offset,
                angle=seen.angle + angle,
                curvature=None,
                offset_std_m=std,
                angle_std_rad=std / 6.0,
            )

        with World(Road(find_track("town"))) as world:
            world.reset(seed=0)
            state = TrustedPerception[World](perceive, lambda world: world.state, dt=DT)
            found[trusted] = run_lap(world, Lqr(DT), state if trusted else perceive, 500)
    assert found[True].ended is None
    assert found[True].mean_abs_d_m < 0.5 * found[False].mean_abs_d_m
