"""Means, linear fits and spreads that are robust to outliers."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

ROUNDS = 12
TUNING = 1.5
"""Errors above this number of standard deviations count linearly, not squared (Huber 1981)."""


def fit(design: FloatArray, values: FloatArray, weight: FloatArray) -> FloatArray:
    """Return coefficients (P,) of `values` (N,) = `design` (N, P) @ coefficients, fitted with the
    weights `weight` (N,) times Huber's weights."""
    root = np.sqrt(weight)
    found: FloatArray = np.zeros(design.shape[1])
    scale = root
    for step in range(ROUNDS):
        rows = (root * scale if step else root)[:, None] * design
        target = (root * scale if step else root) * values
        found = np.asarray(np.linalg.lstsq(rows, target, rcond=None)[0], np.float64)
        error = np.abs(values - design @ found) * root
        limit = TUNING * 1.4826 * float(np.median(error)) + 1e-12
        scale = 1.0 / np.sqrt(np.maximum(1.0, error / limit))
    return found


def mean(values: FloatArray, weight: FloatArray | None = None) -> float:
    """Return Huber's robust mean of `values` (N,). `weight` (N,): weights of the values; None: all
    1."""
    ones = np.ones((len(values), 1))
    return float(fit(ones, values, np.ones(len(values)) if weight is None else weight)[0])


def bootstrap_std(
    block: NDArray[np.int64],
    estimate: Callable[[NDArray[np.int64]], FloatArray],
    rng: np.random.Generator,
    draws: int = 60,
) -> FloatArray:
    """Return the standard deviations (P,) of `estimate(rows)` over resampled blocks of rows
    (bootstrap, Efron 1979): half the width of the central 68 % interval.

    `block` (N,): number of the block of each row; `estimate`: computes P values from row indices
    (M,).
    """
    rows_of = [np.flatnonzero(block == name) for name in np.unique(block)]
    found = []
    for _ in range(draws):
        chosen = rng.integers(len(rows_of), size=len(rows_of))
        found.append(estimate(np.concatenate([rows_of[k] for k in chosen])))
    low, high = np.nanpercentile(np.array(found), [15.87, 84.13], axis=0)
    return np.asarray(0.5 * (high - low), np.float64)
