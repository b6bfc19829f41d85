"""Nonlinear model predictive control: the paper's second controller.

The model is the kinematic single-track model (Kong et al. 2015, "Kinematic and dynamic vehicle
models for autonomous driving control design"), in Euler steps of a control step (50 ms), over a
horizon of 10 steps:

    y' = v sin(psi + beta), psi' = v cos(beta) / (lf + lr) tan(delta)
    beta = atan(lr / (lf + lr) tan(delta)), |delta| <= the steering lock

The cost is the paper's: sum(q_y (y - y_ref)^2 + q_psi (psi - psi_ref)^2 + r delta^2). The model
leaves x out, because neither the cost nor y and psi depend on it.

The solver is control-limited differential dynamic programming (Tassa, Mansard, Todorov 2014) with
Gauss-Newton second derivatives. With one input its quadratic programs are scalars, so a solve is a
few passes of compiled code over the horizon. A solve starts from the last solution, shifted by one
step.

`mpc` has no preview: its reference is the tangent of the lane at the car, because it receives the
same information as `lqr` and `rl`. The reference of `mpc-preview` is an arc of the curvature just
ahead; the paper's reference is the centre line. Deviations from the paper:
- The weights are tuned, with a softer set for a perceived state; the paper sets all to 1.
- The curvature of the reference is constant over the horizon.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from controllers.interface import (
    ANGLE,
    CURVATURE,
    HEADING,
    OBSERVED,
    TO_LANE_CENTRE,
    VX,
    YAW_RATE,
    BatchController,
    LoopConfig,
    Observations,
)
from controllers.laws.steering import STEERING_LOCK, steer_for
from controllers.perception.curvature import next_curvature
from runtime.jit import compiled, compiled_for_threads
from simulator.vehicle.car import CarParameters

Vector = NDArray[np.float64]

HORIZON = 10
"""Number of control steps of a plan; the paper compares 8, 10 and 12 steps."""
REAR_AXLE_M, WHEELBASE_M = CarParameters.rear_axle, CarParameters().wheelbase
CURVATURE_FILTER_S = 0.4
MAX_ITERATIONS = 30
TOLERANCE = 1e-10
"""Relative decrease of the cost at which the solver stops."""


@dataclass(frozen=True)
class MpcWeights:
    """Weights of the cost: offset per m2, heading per rad2, front wheel angle per rad2."""

    offset: float
    heading: float
    wheel: float


WEIGHTS_PAPER = MpcWeights(1.0, 1.0, 1.0)
WEIGHTS_EXACT = MpcWeights(1.0, 3.0, 0.03)
"""Weights tuned in drives with the exact state on the paper's four tracks. With three times this
weight of the offset the car begins to oscillate, because it turns more slowly than the kinematic
model."""
WEIGHTS_PERCEIVED = MpcWeights(1.0, 20.0, 2.0)


def make_mpc(loop: LoopConfig, **weights: float) -> "Mpc":
    """Make an `Mpc` for a control loop; `weights` replace fields of its `MpcWeights`."""
    return Mpc(loop.dt, replace(_weights(loop), **weights))


def make_mpc_preview(loop: LoopConfig, **weights: float) -> "Mpc":
    """Make an `Mpc` whose reference follows the curvature of the road just ahead; `weights` replace
    fields of its `MpcWeights`."""
    return Mpc(loop.dt, replace(_weights(loop), **weights), preview=True)


def _weights(loop: LoopConfig) -> MpcWeights:
    return WEIGHTS_PERCEIVED if loop.noisy else WEIGHTS_EXACT


class Mpc(BatchController):
    """Model predictive control at a control step of `dt` s. Each solve starts from the last
    solution, which the object keeps."""

    def __init__(
        self,
        dt: float = 0.05,
        weights: MpcWeights = WEIGHTS_EXACT,
        *,
        horizon: int = HORIZON,
        preview: bool = False,
    ) -> None:
        self.dt, self.weights, self.horizon, self.preview = dt, weights, horizon, preview
        self.plans: Vector = np.zeros((0, horizon))
        """Planned front wheel angles (rad) of each car, one for each step of the horizon."""
        self._cost = np.array([weights.offset, weights.heading, weights.wheel])
        self._curvatures = np.zeros(0)
        self.update_batch(Observations(np.zeros((0, OBSERVED))))  # compiles

    def update_batch(self, observations: Observations) -> Vector:
        if len(self.plans) != len(observations):
            self.plans = np.zeros((len(observations), self.horizon))
            self._curvatures = np.zeros(len(observations))
        rows, curvatures = observations.rows, self._curvatures
        return plan_cars(rows, self.plans, curvatures, self.preview, self.dt, self._cost)


@compiled_for_threads
def plan_cars(
    seen: Vector, plans: Vector, curvatures: Vector, preview: bool, dt: float, cost: Vector
) -> Vector:
    """Return the steering actions (N,) for `seen` (N, 7), the rows of `Observations`.

    `plans` (N, n), the front wheel angles (rad) that were planned in the last step, are replaced by
    the new plans. With `preview` the reference has the measured curvature of the road, or, where it
    is not measured, the estimate in `curvatures` (N,), 1/m, which is updated in place. Without
    `preview` the reference is straight. `cost` (3,): weights of offset, heading and wheel angle.
    """
    steers = np.empty(len(seen))
    for k in range(len(seen)):
        vx, plan, curvature = seen[k, VX], plans[k], 0.0
        if preview:
            curvature = seen[k, CURVATURE]
            if math.isnan(curvature):
                before, yaw_rate, road = curvatures[k], seen[k, YAW_RATE], seen[k, HEADING]
                curvatures[k] = next_curvature(before, yaw_rate, vx, road, dt, CURVATURE_FILTER_S)
                curvature = curvatures[k]
        for step in range(len(plan) - 1):
            plan[step] = plan[step + 1]
        offset, heading, speed = seen[k, TO_LANE_CENTRE], -seen[k, ANGLE], max(vx, 0.0)
        solve(plan, offset, heading, speed, dt, curvature, cost)
        steers[k] = steer_for(plan[0])
    return steers


@compiled
def roll_out(plan: Vector, speed: float, dt: float, states: Vector) -> None:
    """Fill the rows 1 to n of `states` (n + 1, 2), y (m) and psi (rad), from row 0, the start.

    `plan` (n,) has the wheel angles (rad) of the steps of `dt` s; `speed` (m/s) is constant.
    """
    for k in range(len(plan)):
        slope = math.tan(plan[k])
        slip = math.atan(REAR_AXLE_M / WHEELBASE_M * slope)
        states[k + 1, 0] = states[k, 0] + dt * speed * math.sin(states[k, 1] + slip)
        states[k + 1, 1] = states[k, 1] + dt * speed * math.cos(slip) / WHEELBASE_M * slope


@compiled
def plan_cost(
    plan: Vector, states: Vector, speed: float, dt: float, curvature: float, cost: Vector
) -> float:
    """Return the cost of `plan` (n,), the wheel angles (rad) that lead to `states` (n + 1, 2).

    `curvature` (1/m) is the curvature of the reference; `cost` (3,) has the weights of offset,
    heading and wheel angle.
    """
    total = 0.0
    for k in range(len(plan)):
        turned = curvature * speed * dt * (k + 1)
        side = 0.5 * turned * speed * dt * (k + 1)
        total += cost[0] * (states[k + 1, 0] - side) ** 2
        total += cost[1] * (states[k + 1, 1] - turned) ** 2 + cost[2] * plan[k] ** 2
    return total


@compiled
def backward_pass(
    plan: Vector,
    states: Vector,
    speed: float,
    dt: float,
    curvature: float,
    cost: Vector,
    steps: Vector,
) -> None:
    """Fill `steps` (n, 3) with the improvement of each step of `plan`, from the last step to the
    first.

    A row has the change of the wheel angle (rad), limited so that the angle stays within the
    steering lock, and the feedback gains of the wheel angle on changes of y and psi. `plan`,
    `states`, `curvature` and `cost` are the arguments of `plan_cost`.
    """
    n = len(plan)
    share = REAR_AXLE_M / WHEELBASE_M
    gy = gp = hyy = hyp = hpp = 0.0  # gradient and Hessian of the cost to go
    for k in range(n - 1, -1, -1):
        turned = curvature * speed * dt * (k + 1)
        side = 0.5 * turned * speed * dt * (k + 1)
        gy += 2.0 * cost[0] * (states[k + 1, 0] - side)
        gp += 2.0 * cost[1] * (states[k + 1, 1] - turned)
        hyy += 2.0 * cost[0]
        hpp += 2.0 * cost[1]
        slope = math.tan(plan[k])
        secant = 1.0 + slope * slope
        round_ = 1.0 + share * share * slope * slope
        a = dt * speed * math.cos(states[k, 1] + math.atan(share * slope))  # dy / dpsi
        by = a * share * secant / round_
        bp = dt * speed / WHEELBASE_M * secant / round_**1.5
        slope_u = 2.0 * cost[2] * plan[k] + by * gy + bp * gp
        curve_u = 2.0 * cost[2] + by * by * hyy + 2.0 * by * bp * hyp + bp * bp * hpp
        # Hessian of the input with (y, psi) before the step, whose transition is [[1, a], [0, 1]].
        cross_y = by * hyy + bp * hyp
        cross_p = cross_y * a + by * hyp + bp * hpp
        curve_u = max(curve_u, 1e-12)
        free = -slope_u / curve_u
        change = min(max(free, -STEERING_LOCK - plan[k]), STEERING_LOCK - plan[k])
        fy = -cross_y / curve_u if change == free else 0.0
        fp = -cross_p / curve_u if change == free else 0.0
        steps[k, 0], steps[k, 1], steps[k, 2] = change, fy, fp
        # The cost to go before this step.
        gp += a * gy
        hpp += 2.0 * a * hyp + a * a * hyy
        hyp += a * hyy
        gy += fy * (curve_u * change + slope_u) + cross_y * change
        gp += fp * (curve_u * change + slope_u) + cross_p * change
        hyy += fy * (curve_u * fy + 2.0 * cross_y)
        hyp += fy * curve_u * fp + fy * cross_p + cross_y * fp
        hpp += fp * (curve_u * fp + 2.0 * cross_p)


@compiled
def solve(
    plan: Vector,
    offset: float,
    heading: float,
    speed: float,
    dt: float,
    curvature: float,
    cost: Vector,
) -> int:
    """Replace `plan` (n,), front wheel angles in rad, by the best plan; return the iterations used.

    `offset` (m, left positive) and `heading` (rad, counter-clockwise) are relative to the lane.
    `speed` is in m/s, the control step `dt` in s, the `curvature` of the reference in 1/m. `cost`
    (3,) has the weights of offset, heading and wheel angle.
    """
    n = len(plan)
    states, trial = np.zeros((n + 1, 2)), np.zeros((n + 1, 2))
    steps, other = np.zeros((n, 3)), np.zeros(n)
    states[0, 0], states[0, 1] = offset, heading
    trial[0] = states[0]
    roll_out(plan, speed, dt, states)
    best = plan_cost(plan, states, speed, dt, curvature, cost)
    for iteration in range(MAX_ITERATIONS):
        backward_pass(plan, states, speed, dt, curvature, cost, steps)
        share, better = 1.0, False
        while share > 1e-3 and not better:
            for k in range(n):
                wanted = plan[k] + share * steps[k, 0]
                wanted += steps[k, 1] * (trial[k, 0] - states[k, 0])
                wanted += steps[k, 2] * (trial[k, 1] - states[k, 1])
                other[k] = min(max(wanted, -STEERING_LOCK), STEERING_LOCK)
                roll_out(other[k : k + 1], speed, dt, trial[k : k + 2])
            found = plan_cost(other, trial, speed, dt, curvature, cost)
            better = found < best
            share *= 0.5
        if not better:
            return iteration
        gained = best - found
        plan[:], states[:], best = other, trial, found
        if gained <= TOLERANCE * best:
            return iteration + 1
    return MAX_ITERATIONS
