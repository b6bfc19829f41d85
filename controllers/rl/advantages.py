"""Discount factors, and generalised advantage estimation (Schulman et al. 2016). SI units."""

import numpy as np
from numpy.typing import NDArray

from controllers.laws.actor_state import STEP_S

Array = NDArray[np.float32]
SLOWEST_M_S = 1.0
"""Lower bound (m/s) of the speed from which the discount factor is computed. Without this bound the
discount factor of a car at rest would be 1."""


def advantages_of(
    rewards: Array,
    values: Array,
    next_values: Array,
    ended: NDArray[np.bool_],
    over: NDArray[np.bool_],
    discounts: Array,
    gae_lambda: float,
) -> Array:
    """Return the generalised advantage estimates (T, N) of T steps of N cars.

    All arrays are (T, N). `values` are the critic's values of the states before the steps.
    `next_values` are its values of the states that the steps reached (at the end of an episode, not
    of the first state of the next episode). `ended`: whether the step reached a terminal state,
    whose value is 0. `over`: whether the step was the last step
    of its episode, so that later steps do not count. `discounts`: discount factor of each step.
    `gae_lambda`: lambda of Schulman et al., 0 to 1.
    """
    found = np.zeros_like(rewards)
    errors = rewards + discounts * next_values * ~ended - values
    following = np.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        following = errors[t] + discounts[t] * gae_lambda * ~over[t] * following
        found[t] = following
    return found


def discounts_at(speeds: Array, length_m: float) -> Array:
    """Return the discount factors exp(-distance / length_m) of control steps at `speeds` (m/s, at
    least 1), an array of any shape."""
    distances = STEP_S * np.maximum(speeds, SLOWEST_M_S)
    factors: Array = np.exp(-distances / length_m).astype(np.float32)
    return factors
