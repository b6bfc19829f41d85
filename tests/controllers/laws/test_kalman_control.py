"""LQR and MPC on an estimated state: the gain's closed form, drives with noise and delay."""

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from controllers.drive.closed_loop import DriveResult
from controllers.drive.config import DriveConfig
from controllers.drive.disturbance import DISTURBANCES
from controllers.drive.run import drive
from controllers.interface import LoopConfig, Observation, Observations
from controllers.laws.kalman import CAR, StateEstimate, Vector
from controllers.laws.kalman_control import smooth_gain
from controllers.laws.lqr_gains import LqrWeights, discrete_gain
from controllers.registry import make_controller
from trackfeatures import RoadClass

STEPS = 900
ESTIMATED = ("lqr-kalman", "mpc-kalman")


@cache
def driven(controller: str, disturbance: str) -> tuple[DriveResult, float]:
    """A drive from beside the line, and the mean change of its steering action in a step."""
    actions: list[float] = []
    result = drive(
        DriveConfig(controller=controller, track="circuit", steps=STEPS, start_d=1.0),
        disturbance=DISTURBANCES[disturbance],
        observers=[lambda state, perceived, steer: actions.append(steer)],
    )
    return result, float(np.abs(np.diff(actions)).mean())


@pytest.mark.parametrize("speed", [5.0, 15.0, 30.0])
def test_without_weight_on_its_change_the_wheel_angle_is_that_of_the_regulator(
    speed: float,
) -> None:
    weights = LqrWeights(2.0, 0.2, 2.0, 0.1, 0.01)
    found = smooth_gain(weights, 0.0, speed, 0.05)
    np.testing.assert_allclose(found[:4], discrete_gain(CAR, weights, speed, 0.05), rtol=1e-6)
    assert found[4] == pytest.approx(1.0)  # the old wheel angle is replaced


@pytest.mark.parametrize("controller", ESTIMATED)
def test_with_noise_the_steering_is_a_third_as_restless_as_that_of_lqr(controller: str) -> None:
    (plain, restless), (found, smooth) = driven("lqr", "noise"), driven(controller, "noise")
    assert found.ended is None
    assert smooth < restless / 3
    assert found.score > plain.score


@pytest.mark.parametrize("controller", ESTIMATED)
def test_with_a_delay_the_score_is_near_that_without(controller: str) -> None:
    (plain, _), (late, _) = driven(controller, "none"), driven(controller, "delay")
    assert driven("lqr", "delay")[0].score_per_step < plain.score_per_step - 0.05
    assert late.score_per_step > plain.score_per_step - 0.015


@pytest.mark.parametrize("controller", ESTIMATED)
def test_without_disturbance_nothing_is_lost(controller: str) -> None:
    plain = driven(controller.removesuffix("-kalman"), "none")[0]
    assert driven(controller, "none")[0].score_per_step > plain.score_per_step - 0.0003


@pytest.mark.parametrize("controller", ESTIMATED)
def test_a_drive_on_images_knows_that_its_answers_are_predicted_to_the_present(
    controller: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    known: list[bool] = []
    real = StateEstimate.update

    def update(self: StateEstimate, seen: Observations, wheel_angles: Vector) -> Vector:
        states = real(self, seen, wheel_angles)
        known.append(bool(self.delays["is_known"][0]))
        return states

    monkeypatch.setattr(StateEstimate, "update", update)
    config = DriveConfig(controller=controller, perception="model", track="oval", steps=2)
    drive(config)
    assert known == [True, True]
    drive(config, disturbance=DISTURBANCES["noise"])
    assert known == [True, True, False, False]


@pytest.mark.parametrize("name", ["to_lane_centre", "angle", "vx", "vy", "yaw_rate"])
@pytest.mark.parametrize("controller", ESTIMATED)
def test_one_measurement_that_is_not_finite_does_not_stay_in_the_filter(
    controller: str, name: str
) -> None:
    good = Observation(0.3, 0.01, RoadClass.STRAIGHT, vx=15.0, vy=0.0, yaw_rate=0.0)
    steered = []
    changes: list[dict[str, Any]] = [{}, {name: math.nan}, {name: -math.inf}]
    for bad in (replace(good, **change) for change in changes):
        law = make_controller(controller, LoopConfig(dt=0.05, noisy=True))
        steered.append([law.update(bad if k == 10 else good) for k in range(16)])
    assert max(map(abs, steered[0])) > 0.01
    np.testing.assert_array_equal(steered[1:], [steered[0]] * 2)
