"""Compiled functions that estimate the delay of a perception from the car's yaw rate. SI units.

The estimate is the number of control steps by which the perceived heading lags behind the measured
yaw rate. The heading error theta changes by theta' = r - kappa vx, with the yaw rate r and the
road's curvature kappa. For each delay of 0 to `MAX_DELAY` steps, the residual is the second
difference of theta minus the second difference of the integrated yaw rate. It contains the noise,
the change of kappa, which is small, and for a wrong delay the motion of the car. The squares of the
residuals are compared over the last `WINDOW` steps.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from trackfeatures.errors import UserError

Vector = NDArray[np.float64]

MAX_DELAY = 4
"""Longest delay in control steps: 0.2 s at 20 Hz."""
SPANS = (1, 4)
"""Control steps over which second differences are taken. With a short span the estimate is exact if
there is no noise. A second difference over a long span contains more of the car's motion but no
more noise."""
LONGEST = max(SPANS)
WINDOW, FEWEST = 200, 20
"""Largest and least number of control steps whose residuals are compared."""
SURE = 3.5
"""Number of standard errors by which a delay must explain the measurements better than any other
delay."""

DELAY_MEMORY = np.dtype(
    [
        # The delay that is assumed: 0 until the measurements contradict it.
        ("steps", np.int64),
        # Whether the delay was given, or the measurements have separated one delay from all others.
        ("is_known", np.bool_),
        ("is_given", np.bool_),
        ("count", np.int64),
        ("rates", np.float64, MAX_DELAY + 2),
        # rad, integrals of the yaw rate of 0 to MAX_DELAY steps ago.
        ("turned", np.float64, MAX_DELAY + 1),
        ("residuals", np.float64, (2 * LONGEST + 1, MAX_DELAY + 1)),
        ("squares", np.float64, (len(SPANS), WINDOW, MAX_DELAY + 1)),
    ]
)
"""The values that the estimate of one car's delay keeps between two control steps."""


def first_delays(cars: int, dt: float, known_s: float | None = None) -> NDArray[Any]:
    """Return the initial delay estimates (N,) of N = `cars` cars, of the type DELAY_MEMORY.

    `known_s`: the delay in s, which is then not estimated; None if it is unknown. Raises UserError
    for a delay below 0 or of more than 4 steps of `dt` s.
    """
    memory = np.zeros(cars, DELAY_MEMORY)
    if known_s is not None:
        steps = round(known_s / dt)
        if not 0 <= steps <= MAX_DELAY:
            raise UserError(
                f"the perception's delay is {known_s:g} s; lqr-kalman and mpc-kalman take 0 to "
                f"{MAX_DELAY * dt:g} s"
            )
        memory["steps"], memory["is_known"], memory["is_given"] = steps, True, True
    return memory


@compiled
def update_delay(memory: Any, theta: float, yaw_rate: float, dt: float) -> bool:
    """Update the delay estimate of one car by a control step of `dt` s; return whether the
    estimated delay changed.

    `memory` is an element of the result of `first_delays`, and `memory.steps` the estimated delay.
    `theta` is the perceived heading error (rad), `yaw_rate` the present yaw rate (rad/s).
    """
    if memory.is_given:
        return False
    rates, turned, residuals = memory.rates, memory.turned, memory.residuals
    for k in range(MAX_DELAY + 1, 0, -1):
        rates[k] = rates[k - 1]
    rates[0] = yaw_rate
    for k in range(MAX_DELAY + 1):
        for row in range(2 * LONGEST, 0, -1):
            residuals[row, k] = residuals[row - 1, k]
        turned[k] += 0.5 * dt * (rates[k + 1] + rates[k])
        residuals[0, k] = theta - turned[k]
    memory.count += 1
    # The first residuals contain rates of before the first step and are not counted.
    count = memory.count - (2 * LONGEST + MAX_DELAY)
    if count <= 0:
        return False
    for i in range(len(SPANS)):
        span = SPANS[i]
        for k in range(MAX_DELAY + 1):
            second = residuals[0, k] - 2.0 * residuals[span, k] + residuals[2 * span, k]
            memory.squares[i, (count - 1) % WINDOW, k] = second * second
    before = memory.steps
    if count >= FEWEST:
        for i in range(len(SPANS)):
            decide(memory, memory.squares[i, : min(count, WINDOW)], SPANS[i])
    return bool(before != memory.steps)


@compiled
def decide(memory: Any, compared: Vector, span: int) -> None:
    """Change the estimated delay `memory.steps` if another delay explains the measurements better.

    `compared` (n, 5) has the squared residuals of n steps for delays of 0 to 4 steps. The best
    delay has the smallest mean. It becomes the estimate if this mean is smaller than the mean of
    the present estimate by 3.5 standard errors. `memory.is_known` is set if the estimate changes,
    or is better than all other delays by this margin. `span`: control steps of a second difference.
    """
    n, best = len(compared), 0
    sums = np.zeros(MAX_DELAY + 1)
    for row in range(n):
        for k in range(MAX_DELAY + 1):
            sums[k] += compared[row, k]
    for k in range(MAX_DELAY + 1):
        if sums[k] / n < sums[best] / n:
            best = k
    # Neighbouring second differences over several steps have measurements in common.
    independent = n / span
    others_are_worse = True
    for k in range(MAX_DELAY + 1):
        if k == best:
            continue
        total = spread = 0.0
        for row in range(n):
            total += compared[row, k] - compared[row, best]
        mean = total / n
        for row in range(n):
            spread += (compared[row, k] - compared[row, best] - mean) ** 2
        sure = mean > SURE * (math.sqrt(spread / n) / math.sqrt(independent))
        others_are_worse = others_are_worse and sure
        if k == memory.steps and sure:
            memory.steps, memory.is_known = best, True
            return
    if best == memory.steps and others_are_worse:
        memory.is_known = True
