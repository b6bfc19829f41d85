"""The estimates of delay and state: simulated noise, an oracle for the transitions."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from controllers.interface import Observation, Observations
from controllers.laws.delay import FEWEST, LONGEST, MAX_DELAY, first_delays, update_delay
from controllers.laws.kalman import CAR, KAPPA, StateEstimate, transitions
from controllers.laws.lqr_gains import GRID_M_S, SLOWEST_M_S
from trackfeatures import RoadClass
from trackfeatures.errors import UserError

DT = 0.05
SPEED = 15.0
ROW = round((SPEED - SLOWEST_M_S) / GRID_M_S)


def motion(steps: int, hz: float = 1.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Heading error (rad) and yaw rate (rad/s) of a car that oscillates on a straight road."""
    time = DT * np.arange(steps)
    omega = 2.0 * math.pi * hz
    return 0.05 * np.sin(omega * time), 0.05 * omega * np.cos(omega * time)


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("delay", range(MAX_DELAY + 1))
def test_the_delay_of_the_heading_is_found(delay: int, noise: float) -> None:
    rng = np.random.default_rng(delay)
    theta, rate = motion(400)
    found = first_delays(1, DT)[0]
    for now in range(delay, 400):
        seen = theta[now - delay] + 0.005 * noise * rng.normal()
        update_delay(found, seen, rate[now] + 0.01 * noise * rng.normal(), DT)
    assert found["is_known"]
    assert found["steps"] == delay


def test_a_given_delay_is_kept() -> None:
    theta, rate = motion(400)
    found = first_delays(1, DT, 0.1)[0]
    assert found["is_known"]
    assert not any(update_delay(found, theta[now], rate[now], DT) for now in range(400))
    assert found["steps"] == 2


def test_a_given_delay_that_is_too_long_is_refused() -> None:
    with pytest.raises(UserError, match=r"delay is 0\.25 s; .* take 0 to 0\.2 s"):
        StateEstimate(DT, 0.25)


def test_without_motion_the_delay_stays_unknown() -> None:
    rng = np.random.default_rng(1)
    found = first_delays(1, DT)[0]
    for _ in range(400):
        assert not update_delay(found, 0.005 * rng.normal(), 0.01 * rng.normal(), DT)
    assert found["steps"] == 0
    assert not found["is_known"]


def test_the_newest_sample_is_compared_and_no_empty_one() -> None:
    theta, rate = motion(MAX_DELAY + 2 * LONGEST + FEWEST)
    found = first_delays(1, DT)[0]
    for now in range(len(theta)):
        update_delay(found, theta[now], rate[now], DT)
    filled = np.any(found["squares"] > 0.0, axis=(0, 2))
    assert filled[:FEWEST].all()
    assert not filled[FEWEST:].any()


def test_transitions_are_those_of_the_lateral_model() -> None:
    """(e1, e1', e2, e2') is a linear map of (e, theta, vy, r) on a straight road."""
    maps = np.array([[1, 0, 0, 0], [0, SPEED, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)
    A, B = CAR.discretise(SPEED, DT)
    step = transitions(DT)[ROW]
    np.testing.assert_allclose(maps @ step[:KAPPA, :KAPPA], A @ maps, atol=1e-10)
    np.testing.assert_allclose(maps @ step[:KAPPA, 5:], B, atol=1e-10)


def test_in_a_steady_bend_the_heading_follows_the_road() -> None:
    """Yaw rate = curvature times speed: theta does not change."""
    step = transitions(DT)[ROW]
    moved = step[:, :5] @ np.array([0.0, 0.0, 0.0, SPEED * 0.01, 0.01])
    assert moved[KAPPA] == 0.01
    model = transitions(2 * DT)[ROW]
    twice = step[:, :5] @ step[:, :5]
    np.testing.assert_allclose(model[:, :5], twice, atol=1e-12)


def drive(
    steps: int, delay: int, noise: float, sway: float = 0.02
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """True and estimated states (steps, 5) of the model's own car on a road of 200 m radius."""
    rng = np.random.default_rng(7)
    step, truth = transitions(DT)[ROW], np.zeros((steps, 5))
    truth[:, KAPPA] = 0.005
    estimate, found = StateEstimate(DT), np.zeros((steps, 5))
    wheel = 0.0
    for now in range(steps):
        if now:
            truth[now] = step[:, :5] @ truth[now - 1] + step[:, 5] * wheel
        seen = truth[max(now - delay, 0)]
        error = noise * rng.normal(size=4) * (0.05, 0.005, 0.1, 0.01)
        observation = Observation(
            to_lane_centre=seen[0] + error[0],
            angle=-(seen[1] + error[1]),
            heading=RoadClass.LEFT,
            vx=SPEED,
            vy=truth[now, 2] + error[2],
            yaw_rate=truth[now, 3] + error[3],
        )
        found[now] = estimate.update(Observations.of(observation), np.array([wheel]))[0]
        wheel = 0.013 + sway * math.sin(6.0 * DT * now) - 0.02 * truth[now, 0] - 0.3 * truth[now, 1]
    assert estimate.delays["steps"][0] == delay
    return truth, found


def test_without_noise_the_state_is_exact() -> None:
    truth, found = drive(400, 0, 0.0)
    np.testing.assert_allclose(found[200:, :4], truth[200:, :4], atol=1e-3)
    np.testing.assert_allclose(found[200:, KAPPA], 0.005, atol=2e-4)


def test_noise_is_reduced() -> None:
    truth, found = drive(800, 0, 1.0)
    error = (found - truth)[200:].std(axis=0)
    assert error[0] < 0.4 * 0.05
    assert error[1] < 0.6 * 0.005
    assert error[2] < 0.3 * 0.1


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_late_state_is_predicted_to_the_present(noise: float) -> None:
    truth, found = drive(1200, 2, noise, sway=0.06)
    late = np.abs(truth[400:, :2] - truth[398:-2, :2]).mean(axis=0)
    error = np.abs(truth - found)[400:, :2].mean(axis=0)
    assert late[1] > 0.003
    assert error[1] < 0.5 * late[1]
    if not noise:
        assert error[0] < 0.1 * late[0]
