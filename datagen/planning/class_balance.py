"""How often the road goes left, straight and right in a round that is only planned.

A round drives on from its start at the scripted speed, so the classes of its frames follow from
the track. What traffic costs on one lane is estimated; nothing is simulated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.driving.trajectory import reach
from datagen.planning.plan import RoundPlan, TrackChoice
from simulator.driving.speed import bend_profile
from simulator.track.catalogue import find_track
from simulator.track.geometry import Track
from simulator.track.road import Road
from simulator.traffic.traffic import DESIRED_KMH

FloatArray = NDArray[np.float64]
KMH = 3.6


class Forecast(Protocol):
    """What is expected of a round if it started elsewhere."""

    def __call__(self, entry: RoundPlan, starts: FloatArray) -> FloatArray:
        """Shares (N, 3) of the classes left, straight, right from each of `starts` (N,)."""
        ...


@dataclass(frozen=True)
class _Lap:
    """Cells of a lap: where the track stands for each class, and what the bends allow (m/s)."""

    is_class: NDArray[np.bool_]  # (3, cells)
    limit: FloatArray  # (cells,)
    cell_m: float


class TrackForecast:
    """A Forecast from the geometry of the tracks, by name."""

    def __init__(self, tracks: Mapping[str, Track]) -> None:
        self._tracks = dict(tracks)
        self._lap = cache(self._survey)

    @staticmethod
    def of(choices: tuple[TrackChoice, ...], tracks_dir: Path | None) -> "TrackForecast":
        return TrackForecast({c.name: find_track(c.name, tracks_dir) for c in choices})

    def __call__(self, entry: RoundPlan, starts: FloatArray) -> FloatArray:
        lap = self._lap(entry.track, entry.lanes, entry.lane_width_m)
        seconds = lap.cell_m / np.minimum(lap.limit, expected_speed(entry))
        until = np.concatenate([[0.0], np.cumsum(np.tile(seconds, 2))])
        lap_s = until[len(seconds)]
        first = np.interp(starts * len(seconds), np.arange(len(until)), until)
        laps, rest = divmod(entry.frames / entry.frequency_hz, lap_s)
        spent = np.zeros((len(starts), len(tf.Heading)))
        for kind in tf.Heading:
            in_class = np.concatenate([[0.0], np.cumsum(np.tile(seconds * lap.is_class[kind], 2))])
            spent[:, kind] = (
                laps * in_class[len(seconds)]
                + np.interp(first + rest, until, in_class)
                - np.interp(first, until, in_class)
            )
        return np.asarray(spent / spent.sum(axis=1, keepdims=True))

    def _survey(self, name: str, lanes: int, lane_width_m: float) -> _Lap:
        track = self._tracks[name]
        profile = bend_profile(track, reach(Road(track, lanes, lane_width_m)))
        s = (np.arange(len(profile.limit)) + 0.5) * profile.cell_m
        here, ahead = track.at(s).curvature, track.at(s + tf.LOOK_AHEAD_M).curvature
        pairs = zip(here.tolist(), ahead.tolist(), strict=True)
        heading = np.array([tf.classify_heading(k, then) for k, then in pairs])
        return _Lap(
            np.stack([heading == kind for kind in tf.Heading]), profile.limit, profile.cell_m
        )


def expected_speed(entry: RoundPlan) -> float:
    """m/s on a straight: on one lane, the slowest of the cars in front is not overtaken."""
    speed = entry.speed_kmh
    if entry.lanes == 1 and entry.traffic:
        low, high = DESIRED_KMH
        speed = min(speed, low + (high - low) / (entry.traffic + 1))
    return speed / KMH


# Choosing where rounds start so that no class of the road ahead becomes rare. Roads are straight
# for most of their length, and circuits turn one way more than the other. The rounds whose start
# helps most are moved, as few as it takes.


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
