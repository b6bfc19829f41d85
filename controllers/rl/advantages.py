"""Discount factors and generalised advantage estimates (Schulman et al. 2016). SI units."""

import numpy as np
from numpy.typing import NDArray

from controllers.laws.actor_state import STEP_S

Array = NDArray[np.float32]
SLOWEST_M_S = 1.0
"""Least speed for the discount factor, which would be 1 for a car at rest."""


def advantages_of(
    rewards: Array,
    values: Array,
    next_values: Array,
    ended: NDArray[np.bool_],
    over: NDArray[np.bool_],
    discounts: Array,
    gae_lambda: float,
) -> Array:
    """Generalised advantage estimates (T, N).

    All arrays are (T, N). `discounts`: the discount factors of the steps. `next_values`: values of
    the states that the steps led to, before any reset; after a terminal state (`ended`) no reward
    follows. An episode that is `over` passes nothing on to the next one.
    """
    found = np.zeros_like(rewards)
    errors = rewards + discounts * next_values * ~ended - values
    following = np.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        following = errors[t] + discounts[t] * gae_lambda * ~over[t] * following
        found[t] = following
    return found


def discounts_at(speeds: Array, length_m: float) -> Array:
    """The discount factors of control steps at these speeds (m/s): exp(-distance / length_m)."""
    distances = STEP_S * np.maximum(speeds, SLOWEST_M_S)
    factors: Array = np.exp(-distances / length_m).astype(np.float32)
    return factors
