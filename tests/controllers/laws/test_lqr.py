"""LQR: closed-form gains, stability of the closed loop, signs, step response."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from controllers.drive.closed_loop import run_lap
from controllers.interface import Controller, LoopConfig, Observation
from controllers.laws.lateral_model import LateralModel, Matrix
from controllers.laws.lqr import (
    RATE,
    WEIGHTS_BRIEFLY_TRAINED,
    WEIGHTS_EXACT,
    WEIGHTS_PAPER,
    WEIGHTS_PERCEIVED,
    Lqr,
    LqrPaper,
    LqrPreview,
    blend_for,
    next_rate,
)
from controllers.laws.lqr_gains import (
    FASTEST_M_S,
    SLOWEST_M_S,
    LqrWeights,
    clqr,
    discrete_gains,
    dlqr,
    row_at,
)
from controllers.laws.steering import STEERING_LOCK
from controllers.laws.torcs_feedback import StateFeedback
from controllers.perception.sources import truth
from controllers.registry import make_controller
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World
from trackfeatures import RoadClass

STRAIGHT_AT_20 = Observation(
    to_lane_centre=0.0,
    angle=0.0,
    heading=RoadClass.STRAIGHT,
    vx=20.0,
    vy=0.0,
    yaw_rate=0.0,
    curvature=0.0,
)


def test_scalar_regulator_has_the_closed_form_gain() -> None:
    """x' = x + u, cost x^2 + u^2: P is the golden ratio, K = P / (1 + P)."""
    gain = dlqr(np.eye(1), np.eye(1), np.eye(1), np.eye(1))
    golden = (1 + math.sqrt(5)) / 2
    assert gain[0, 0] == pytest.approx(golden / (1 + golden))


def test_gain_solves_the_discrete_riccati_equation() -> None:
    """Double integrator at 0.1 s: u = -(R + B'PB)^-1 B'PA x, and P solves the equation."""
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
    Q, R = np.diag([1.0, 0.5]), np.array([[0.2]])
    P = solve_discrete_are(A, B, Q, R)
    gain = dlqr(A, B, Q, R)
    np.testing.assert_allclose(gain, np.linalg.inv(R + B.T @ P @ B) @ B.T @ P @ A, rtol=1e-9)
    np.testing.assert_allclose(Q + A.T @ P @ (A - B @ gain), P, rtol=1e-9)


def test_model_matrices_are_those_of_the_paper() -> None:
    """The entries of A and B at 20 m/s, typed from the paper."""
    A, B, turn = LateralModel().matrices(20.0)
    c, m, inertia, lf, lr, v = 80_000.0, 1150.0, 2000.0, 1.27, 1.37, 20.0
    moment = -2 * c * lf + 2 * c * lr
    spin = -2 * c * lf**2 - 2 * c * lr**2
    expected: Matrix = np.array(
        [
            [0, 1, 0, 0],
            [0, -4 * c / (m * v), 4 * c / m, moment / (m * v)],
            [0, 0, 0, 1],
            [0, moment / (inertia * v), -moment / inertia, spin / (inertia * v)],
        ]
    )
    np.testing.assert_allclose(A, expected)
    np.testing.assert_allclose(B[:, 0], [0, 2 * c / m, 0, 2 * c * lf / inertia])
    assert turn[1, 0] == pytest.approx(moment / (m * v) - v)


def test_discretisation_equals_integration_in_small_steps() -> None:
    model, speed, dt = LateralModel(), 20.0, 0.05
    A, B, _ = model.matrices(speed)
    state, wheel = np.array([0.5, -0.2, 0.05, 0.1]), 0.03
    exact = model.discretise(speed, dt)
    small, parts = state.copy(), 20_000
    for _ in range(parts):
        small = small + (A @ small + B[:, 0] * wheel) * dt / parts
    np.testing.assert_allclose(exact[0] @ state + exact[1][:, 0] * wheel, small, atol=2e-5)


def test_continuous_regulator_of_an_integrator_has_the_closed_form_gain() -> None:
    """dx/dt = u, cost integral(4 x^2 + u^2): K = 2."""
    gain = clqr(np.zeros((1, 1)), np.eye(1), np.array([[4.0]]), np.eye(1))
    assert gain[0, 0] == pytest.approx(2.0)


@pytest.mark.parametrize(
    "weights", [WEIGHTS_EXACT, WEIGHTS_PAPER, WEIGHTS_BRIEFLY_TRAINED, WEIGHTS_PERCEIVED]
)
@pytest.mark.parametrize("dt", [0.02, 0.05, 0.1])
def test_the_closed_loop_is_stable_at_every_speed(weights: LqrWeights, dt: float) -> None:
    gains = discrete_gains(weights, dt)
    for speed in np.arange(5.0, 35.5, 0.5):  # also between the points of the grid
        A, B = LateralModel().discretise(float(speed), dt)
        loop = A - B @ row_at(gains, float(speed))[None, :]
        assert np.abs(np.linalg.eigvals(loop)).max() < 0.999


def test_gains_are_held_beyond_the_grid() -> None:
    gains = discrete_gains(WEIGHTS_EXACT, 0.05)
    np.testing.assert_array_equal(row_at(gains, 0.0), row_at(gains, SLOWEST_M_S))
    np.testing.assert_allclose(row_at(gains, 90.0), row_at(gains, FASTEST_M_S))
    assert np.all(np.isfinite(row_at(gains, -2.0)))


STATE_LAWS = ["lqr", "lqr-preview", "lqr-paper", "mpc", "mpc-preview", "torcs"]


@pytest.mark.parametrize("name", STATE_LAWS)
@pytest.mark.parametrize("noisy", [False, True])
def test_steering_signs(name: str, noisy: bool) -> None:
    def steer(**changes: Any) -> float:
        controller = make_controller(name, LoopConfig(0.05, noisy))
        return controller.update(replace(STRAIGHT_AT_20, **changes))

    assert steer() == 0.0
    assert steer(to_lane_centre=0.05) < 0  # left of the centre: steer right
    assert steer(to_lane_centre=-0.05) > 0
    assert steer(angle=0.01) > 0  # nose to the right of the track: steer left
    assert steer(angle=-0.01) < 0
    if name in ("lqr-preview", "torcs"):  # the only laws that depend on the yaw rate
        assert steer(yaw_rate=0.05) < 0  # turning left on a straight: steer right
    assert steer(to_lane_centre=9.0) == -steer(to_lane_centre=-9.0)
    assert -1.0 <= steer(to_lane_centre=90.0) < -0.3


def test_feed_forward_steers_into_the_bend() -> None:
    """In a steady bend with no error the wheel angle is L k + K_us v^2 k (Rajamani 3.3)."""
    model, speed, curvature = LateralModel(), 15.0, 1 / 60
    wheel, heading = model.cornering(speed)
    load = model.mass / (2 * 80_000.0 * 2.64)
    understeer = load * (model.rear_axle - model.front_axle)
    assert wheel == pytest.approx(2.64 + understeer * speed**2)
    assert heading == pytest.approx(-model.rear_axle + load * model.front_axle * speed**2)
    steady = Observation(
        to_lane_centre=0.0,
        angle=-heading * curvature,
        heading=RoadClass.LEFT,
        vx=speed,
        vy=-speed * math.sin(heading * curvature),
        yaw_rate=speed * curvature,
        curvature=curvature,
    )
    assert LqrPreview().update(steady) * STEERING_LOCK == pytest.approx(wheel * curvature, rel=1e-3)


def response(controller: Controller, speed: float, curvature: float = 0.0) -> Matrix:
    """Offsets (m) of the linear model, 1 m off at the start, over 10 s at 20 Hz."""
    model, dt, parts = LateralModel(), 0.05, 20
    A, B, turn = model.matrices(speed)
    small = np.eye(4) + A * dt / parts  # a small step of Euler's method
    step = np.linalg.matrix_power(small, parts)
    pushed = sum(np.linalg.matrix_power(small, k) for k in range(parts)) * dt / parts
    state, offsets = np.array([1.0, 0.0, 0.0, 0.0]), []
    heading = RoadClass.STRAIGHT if curvature == 0 else RoadClass.LEFT
    for _ in range(200):
        e1, e1_rate, e2, e2_rate = state
        observation = Observation(
            to_lane_centre=e1,
            angle=-e2,
            heading=heading,
            vx=speed,
            vy=e1_rate - speed * math.sin(e2),
            yaw_rate=e2_rate + speed * curvature,
            curvature=None,
        )
        wheel = controller.update(observation) * STEERING_LOCK
        state = step @ state + pushed @ (B[:, 0] * wheel + turn[:, 0] * speed * curvature)
        offsets.append(state[0])
    return np.array(offsets)


@pytest.mark.parametrize("speed", [8.0, 15.0, 22.0])
@pytest.mark.parametrize("weights", [WEIGHTS_EXACT, WEIGHTS_PAPER, WEIGHTS_BRIEFLY_TRAINED])
@pytest.mark.parametrize("form", [Lqr, LqrPreview])
def test_step_response(
    speed: float, weights: LqrWeights, form: type[Lqr] | type[LqrPreview]
) -> None:
    offsets = response(form(0.05, weights), speed)
    assert offsets.min() > -0.15  # overshoots by less than 15 %
    assert np.abs(offsets[100:]).max() < 0.02  # settled within 5 s
    assert np.abs(response(StateFeedback(), speed)[100:]).max() < 0.05


def test_no_steady_offset_in_a_bend_of_unmeasured_curvature() -> None:
    for weights in (WEIGHTS_PAPER, WEIGHTS_BRIEFLY_TRAINED):
        assert abs(response(LqrPreview(0.05, weights), 15.0, 1 / 80)[-1]) < 0.02


def test_the_heading_class_limits_the_estimated_curvature() -> None:
    """A yaw to the left on a road that turns right is an error, not a bend."""
    observation = replace(STRAIGHT_AT_20, yaw_rate=0.4, curvature=None)
    limited = LqrPreview().update(replace(observation, heading=RoadClass.RIGHT))
    estimated = LqrPreview().update(replace(observation, heading=RoadClass.LEFT))
    assert limited < estimated


@pytest.mark.parametrize(
    ("d", "th", "vx", "vy", "yr", "steer"),
    [
        (0.0557, 0.00603, 20.0047, -0.0827, -0.27573, -0.12010),
        (0.1692, 0.01342, 19.7329, -0.0663, -0.80748, -0.36879),
    ],
)
def test_torcs_feedback_reproduces_recorded_steering(
    d: float, th: float, vx: float, vy: float, yr: float, steer: float
) -> None:
    """Two rows of a lap of the real TORCS (forza): the state and its steering."""
    observation = Observation(d, -th, RoadClass.RIGHT, vx, vy, yr)
    assert StateFeedback().update(observation) == pytest.approx(steer, abs=2e-4)


def test_lqr_without_preview_keeps_an_offset_in_a_bend_and_ignores_the_curvature() -> None:
    """In a steady bend -(K1 e1 + K3 e2) is the wheel angle that the bend needs."""
    speed, curvature = 15.0, 1 / 80
    offset = response(Lqr(), speed, curvature)[-1]
    wheel, heading = LateralModel().cornering(speed)
    gain = row_at(discrete_gains(WEIGHTS_EXACT, 0.05), speed)
    assert offset == pytest.approx(-(wheel + gain[2] * heading) * curvature / gain[0], abs=2e-3)
    assert abs(offset) > 2e-3
    known = replace(STRAIGHT_AT_20, to_lane_centre=0.01, curvature=0.02)
    assert Lqr().update(known) == Lqr().update(replace(known, curvature=None))


def test_the_released_codes_form_divides_the_regulators_rad_by_21() -> None:
    """K of the continuous Riccati equation at the paper's car and weights; steer = -K x / 21."""
    A, B, _ = LateralModel().matrices(21.0)  # a point of the grid
    gain = clqr(A, B, np.diag([2.0, 0.2, 2.0, 0.1]), np.array([[0.01]]))[0]
    first = replace(STRAIGHT_AT_20, vx=21.0, to_lane_centre=0.1, angle=-0.02)
    law = LqrPaper()
    assert law.update(first) == pytest.approx(-(gain @ [0.1, 0.0, 0.02, 0.0]) / 21.0)
    second = replace(first, to_lane_centre=0.11, angle=-0.015)
    state = [0.11, 0.2, 0.015, -0.1]  # differences over 0.05 s
    assert law.update(second) == pytest.approx(-(gain @ state) / 21.0)


def test_rates_are_differences_and_can_be_filtered() -> None:
    def rates(values: tuple[float, ...], filter_s: float) -> list[float]:
        memory = np.zeros(RATE)
        return [next_rate(memory, value, 0.05, blend_for(0.05, filter_s)) for value in values]

    assert rates((1.0, 1.1, 1.1), 0.0) == pytest.approx([0.0, 2.0, 0.0])
    assert rates((1.0, 1.1, 1.2), 0.05) == pytest.approx([0.0, 1.0, 1.5])


@pytest.mark.parametrize("name", ["lqr", "lqr-preview", "mpc", "mpc-preview", "rl", "rl-residual"])
def test_a_return_from_far_beside_the_line_stays_within_what_a_model_answers(name: str) -> None:
    """At rest at TORCS's place on a wide grid; the shipped model answers 0.25 rad at most."""
    controller = make_controller(name, LoopConfig(0.05, noisy=True))
    angles = []
    with World(Road(find_track("highway"), lanes=1), frequency_hz=20) as world:
        world.reset(seed=0, to_middle=-2.67)
        result = run_lap(
            *(world, controller, truth(0.0), 240),
            noisy=True,
            record=lambda state, _steer: angles.append(state.angle),
        )
        assert result.ended is None
        assert abs(world.state.to_middle) < 0.1
    assert 0.08 < max(map(abs, angles)) < 0.25
