"""Choosing where rounds start so that no class of the road ahead becomes rare.

Roads are straight for most of their length, and circuits turn one way more than the other. The
rounds whose start helps most are moved, as few as it takes.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from datagen.forecast import Forecast
from datagen.plan import RoundPlan

FloatArray = NDArray[np.float64]

LEAST_SHARE = 0.15
"""No class may have less of the frames..."""
AIM = 0.19
"""...and what is forecast is to be above it by what a forecast errs."""
STARTS = 48
"""Places around the lap that are tried."""
GAIN = 1e-4


def balanced(rounds: Sequence[RoundPlan], forecast: Forecast) -> tuple[RoundPlan, ...]:
    """The same rounds, some with other starts; each side of the split is seen to by itself."""
    made = list(rounds)
    for side in dict.fromkeys(entry.split for entry in made):
        chosen = [i for i, entry in enumerate(made) if entry.split == side]
        for i, start in _better_starts([made[i] for i in chosen], forecast).items():
            made[chosen[i]] = replace(made[chosen[i]], start=start)
    return tuple(made)


def expected_shares(rounds: Sequence[RoundPlan], forecast: Forecast) -> FloatArray:
    """Shares (3,) of left, straight and right over all frames of `rounds`."""
    each = np.array([forecast(entry, np.array([entry.start]))[0] for entry in rounds])
    return np.asarray(np.average(each, axis=0, weights=[entry.frames for entry in rounds]))


def _better_starts(rounds: Sequence[RoundPlan], forecast: Forecast) -> dict[int, float]:
    """New starts by place in `rounds`: the greatest gain first, until no class is below AIM."""
    shares = np.array([forecast(entry, np.array([entry.start]))[0] for entry in rounds])
    tried = [(entry.start + np.arange(STARTS) / STARTS) % 1.0 for entry in rounds]
    options = np.array([forecast(e, starts) for e, starts in zip(rounds, tried, strict=True)])
    moved: dict[int, float] = {}
    while (missing := _missing(shares.mean(axis=0))) > 0.0:
        after = shares.mean(axis=0) + (options - shares[:, None]) / len(rounds)
        gain = missing - _missing(after)
        gain[list(moved)] = 0.0
        i, k = np.unravel_index(int(np.argmax(gain)), gain.shape)
        if gain[i, k] < GAIN / len(rounds):
            break
        shares[i] = options[i, k]
        moved[int(i)] = round(float(tried[int(i)][k]), 5)
    return moved


def _missing(shares: FloatArray) -> FloatArray:
    """What all classes together lack to AIM; `shares` (..., 3)."""
    return np.asarray(np.maximum(AIM - shares, 0.0).sum(axis=-1))
