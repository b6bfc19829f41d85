"""The filter over the answers: against exact motion, noise, outliers, lost offsets."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from mtlnet.inference.track_filter import (
    COAST_S,
    RESTART_AFTER,
    USUAL_STD,
    Estimate,
    Measured,
    TrackFilter,
)

DT, SPEED = 0.05, 20.0


@dataclass
class Car:
    """Sways through a lane of a bend of 100 m radius: a path known at all times."""

    kappa: float = 0.01
    time: float = 0.0

    @property
    def offset(self) -> float:
        return 0.5 * math.sin(self.time)

    @property
    def theta(self) -> float:
        return math.asin(0.5 * math.cos(self.time) / SPEED)

    @property
    def yaw_rate(self) -> float:
        """The mean over the step that ends now."""
        before = math.asin(0.5 * math.cos(self.time - DT) / SPEED)
        return (self.theta - before) / DT + self.kappa * SPEED

    def answer(self, offset_error: float = 0.0, angle_error: float = 0.0) -> Measured:
        return Measured(self.offset + offset_error, -self.theta + angle_error)


def driven(filter_: TrackFilter, car: Car, steps: int, **errors: float) -> Estimate:
    for _ in range(steps):
        car.time += DT
        filter_.predict(DT, SPEED, car.yaw_rate)
        filter_.update(car.answer(**errors))
    return filter_.state


def test_exact_answers_give_offset_angle_and_curvature() -> None:
    car = Car()
    found = driven(TrackFilter(), car, 200)
    assert found.to_lane_centre == pytest.approx(car.offset, abs=0.01)
    assert found.angle == pytest.approx(-car.theta, abs=0.002)
    assert found.curvature == pytest.approx(0.01, abs=5e-4)


def test_white_noise_is_halved_at_least() -> None:
    car, filter_, rng = Car(), TrackFilter(), np.random.default_rng(0)
    errors, noise = [], []
    for _ in range(600):
        error, angle_error = rng.normal(size=2) * USUAL_STD
        found = driven(filter_, car, 1, offset_error=error, angle_error=angle_error)
        assert found.to_lane_centre is not None
        errors.append((found.to_lane_centre - car.offset, found.angle + car.theta))
        noise.append((error, angle_error))
    assert (np.std(errors[100:], axis=0) < 0.5 * np.std(noise[100:], axis=0)).all()


def test_an_outlier_is_left_out_and_a_lasting_jump_is_taken_over() -> None:
    car, filter_ = Car(), TrackFilter()
    driven(filter_, car, 100)
    found = driven(filter_, car, 1, offset_error=3.0)
    assert found.to_lane_centre == pytest.approx(car.offset, abs=0.03)
    found = driven(filter_, car, 20)
    found = driven(filter_, car, RESTART_AFTER, offset_error=-4.0)
    assert found.to_lane_centre == pytest.approx(car.offset, abs=0.05)
    found = driven(filter_, car, 1, offset_error=-4.0)
    assert found.to_lane_centre == pytest.approx(car.offset - 4.0, abs=1e-9)
    assert found.curvature == pytest.approx(0.01, abs=2e-3)


def test_an_answer_of_wide_std_moves_the_estimate_less() -> None:
    moved = []
    for std in (0.05, 0.5):
        filter_ = TrackFilter()
        filter_.update(Measured(0.0, 0.0))
        filter_.predict(DT, SPEED, 0.0)
        moved.append(filter_.update(Measured(0.2, 0.0, std)).to_lane_centre)
    assert moved[0] is not None
    assert moved[1] is not None
    assert 0.0 < moved[1] < 0.2 * moved[0]


def test_a_lost_offset_is_predicted_for_half_a_second() -> None:
    car, filter_ = Car(), TrackFilter()
    driven(filter_, car, 100)
    for step in range(1, 20):
        car.time += DT
        filter_.predict(DT, SPEED, car.yaw_rate)
        found = filter_.update(Measured(None, -car.theta))
        if step * DT < COAST_S - 1e-6:
            assert found.to_lane_centre == pytest.approx(car.offset, abs=0.05)
        elif step * DT > COAST_S + 1e-6:
            assert found.to_lane_centre is None
    assert driven(filter_, car, 1).to_lane_centre == pytest.approx(car.offset, abs=0.05)


def test_an_answer_of_the_service_is_read_with_and_without_std() -> None:
    answer: dict[str, Any] = {"to_lane_centre_m": 0.3, "angle_rad": -0.02, "std": None}
    assert Measured.of(answer) == Measured(0.3, -0.02)
    answer["std"] = {"to_lane_centre": None, "angle": 0.004}
    assert Measured.of(answer) == Measured(0.3, -0.02, USUAL_STD[0], 0.004)


def test_nothing_is_known_before_the_first_answer() -> None:
    filter_ = TrackFilter()
    filter_.predict(DT, SPEED, 0.0)
    with pytest.raises(ValueError, match="nothing was measured"):
        _ = filter_.state
