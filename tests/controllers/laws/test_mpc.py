"""MPC: the solver compared with SciPy's, its constraints, the steps of the model, bends."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from controllers.interface import Observation
from controllers.laws.mpc import HORIZON, Mpc, MpcWeights, Vector, plan_cost, roll_out, solve
from controllers.laws.steering import STEERING_LOCK
from trackfeatures import RoadClass

WEIGHTS = {"paper": MpcWeights(1.0, 1.0, 1.0), "sharp": MpcWeights(10.0, 1.0, 0.01)}


def paper_cost(
    plan: Vector, start: tuple[float, float], speed: float, curvature: float, weights: MpcWeights
) -> float:
    """The paper's cost by its equations, with x, y and psi in the plane."""
    lf, lr, dt = 1.27, 1.37, 0.05
    x, (y, psi), total = 0.0, start, 0.0
    for k, delta in enumerate(plan):
        beta = math.atan(lr / (lf + lr) * math.tan(delta))
        x, y, psi = (
            x + dt * speed * math.cos(psi + beta),
            y + dt * speed * math.sin(psi + beta),
            psi + dt * speed * math.cos(beta) / (lf + lr) * math.tan(delta),
        )
        along = speed * dt * (k + 1)
        total += weights.offset * (y - curvature * along**2 / 2) ** 2
        total += weights.heading * (psi - curvature * along) ** 2 + weights.wheel * delta**2
    return total


@pytest.mark.parametrize("name", WEIGHTS)
@pytest.mark.parametrize("start", [(0.1, 0.02), (-2.0, 0.3), (3.0, 0.0), (0.0, -0.6)])
@pytest.mark.parametrize("curvature", [0.0, 1 / 25])
@pytest.mark.parametrize("speed", [4.0, 20.0])
def test_the_solution_is_that_of_scipy(
    name: str, start: tuple[float, float], curvature: float, speed: float
) -> None:
    weights = WEIGHTS[name]
    plan = np.zeros(HORIZON)
    cost = np.array([weights.offset, weights.heading, weights.wheel])
    solve(plan, *start, speed, 0.05, curvature, cost)
    oracle = minimize(
        paper_cost,
        np.zeros(HORIZON),
        (start, speed, curvature, weights),
        method="SLSQP",
        bounds=[(-STEERING_LOCK, STEERING_LOCK)] * HORIZON,
        options={"ftol": 1e-12, "maxiter": 500},
    )
    found = paper_cost(plan, start, speed, curvature, weights)
    assert np.abs(plan).max() <= STEERING_LOCK
    assert found <= oracle.fun * (1 + 1e-5) + 1e-9
    assert plan[0] == pytest.approx(oracle.x[0], abs=2e-3)


def test_compiled_steps_and_cost_are_those_of_the_equations() -> None:
    rng = np.random.default_rng(1)
    plan, states = rng.uniform(-0.3, 0.3, 8), np.zeros((9, 2))
    states[0] = 0.4, -0.1
    roll_out(plan, 17.0, 0.05, states)
    cost = plan_cost(plan, states, 17.0, 0.05, 0.01, np.array([1.0, 2.0, 3.0]))
    expected = paper_cost(plan, (0.4, -0.1), 17.0, 0.01, MpcWeights(1.0, 2.0, 3.0))
    assert cost == pytest.approx(expected)


def observed(**changes: float) -> Observation:
    values = {"to_lane_centre": 0.0, "angle": 0.0, "vx": 15.0, "vy": 0.0, "yaw_rate": 0.0}
    return Observation(heading=RoadClass.STRAIGHT, curvature=None, **(values | changes))


def test_without_preview_the_curvature_changes_nothing() -> None:
    bend = Observation(0.05, 0.01, RoadClass.LEFT, 15.0, 0.0, 0.3, 1 / 50)
    straight = Observation(0.05, 0.01, RoadClass.LEFT, 15.0, 0.0, 0.0, None)
    assert Mpc().update(bend) == Mpc().update(straight)
    assert Mpc(preview=True).update(bend) > Mpc(preview=True).update(straight)


def test_at_rest_and_far_off_the_answer_is_finite_and_within_the_lock() -> None:
    law = Mpc()
    assert law.update(observed(vx=0.0, to_lane_centre=2.0)) == 0.0
    for offset in (50.0, -50.0):
        steer = law.update(observed(to_lane_centre=offset))
        assert abs(steer) <= 1.0
        assert steer * offset < 0.0


def test_a_warm_start_gives_the_answer_of_a_cold_start() -> None:
    """A warm and a cold start give the same answer."""
    warm = Mpc()
    warm.update(observed(to_lane_centre=1.0))
    again = observed(to_lane_centre=0.9, angle=0.03)
    assert warm.update(again) == pytest.approx(Mpc().update(again), abs=1e-4)
