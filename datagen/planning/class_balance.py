"""Chooses the starts of the rounds so that no class of the road (left, straight, right) is rare.

Roads are straight for most of their length, and circuits turn more to one side than to the other.
The classes of a round's frames are forecast from the track and the scripted speed, without a
simulation; the delay by traffic on one lane is estimated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.driving.placement import placement_share
from datagen.driving.trajectory import max_offset
from datagen.planning.config import TrackChoice
from datagen.planning.plan import RoundPlan
from datagen.recording.names import PLACED
from simulator.driving.speed import bend_profile
from simulator.track.catalogue import find_track
from simulator.track.geometry import Track
from simulator.track.random_roads.road import RANDOM, random_track
from simulator.track.road import Road
from simulator.traffic.traffic import DESIRED_KMH, most_cars

FloatArray = NDArray[np.float64]
KMH = 3.6  # km/h per m/s

MIN_SHARE = 0.15
"""A class with a smaller share of the frames is rare; the table of the plan then has a note."""
TARGET_SHARE = 0.19
"""Forecast share that each class should have: `MIN_SHARE` plus a margin for forecast errors."""
START_CANDIDATES = 48
"""Number of starts tried for each round, evenly spaced around the lap."""
MIN_GAIN = 1e-4
"""A start is changed only if the change reduces the amount that the classes lack to `TARGET_SHARE`
by at least this number divided by the number of rounds. The amount is the sum over the three
classes."""


class Forecast(Protocol):
    """Forecasts the classes of a round's frames for several possible starts of the round."""

    def __call__(self, entry: RoundPlan, starts: FloatArray) -> FloatArray:
        """Return the shares (N, 3) of left, straight and right frames for N possible starts of the
        round `entry`. `starts` (N,) are positions on the lap, as shares of the lap's length."""


@dataclass(frozen=True)
class _LapProfile:
    """A lap divided into cells of equal length, with the road class and speed limit of each."""

    is_class: NDArray[np.bool_]  # (3, cells)
    limit: FloatArray  # (cells,), m/s
    cell_m: float
    placed: FloatArray  # (3,), shares of the classes in a round of the trajectory PLACED


class TrackForecast:
    """A `Forecast` computed from the geometry of `tracks`, a map from names to tracks."""

    def __init__(self, tracks: Mapping[str, Track]) -> None:
        self._tracks = dict(tracks)
        self._lap = cache(self._lap_profile)

    @staticmethod
    def of(choices: tuple[TrackChoice, ...], tracks_dir: Path | None) -> "TrackForecast":
        """Create the forecast for the tracks `choices`, read from their files. A random road is
        generated at the first forecast of a round on it."""
        named = (c.name for c in choices if c.name != RANDOM)
        return TrackForecast({name: find_track(name, tracks_dir) for name in named})

    def __call__(self, entry: RoundPlan, starts: FloatArray) -> FloatArray:
        lap = self._lap(entry.track, entry.lanes, entry.lane_width_m)
        if entry.trajectory == PLACED:
            return np.tile(lap.placed, (len(starts), 1))
        seconds = lap.cell_m / np.minimum(lap.limit, expected_speed(entry))
        # Time at each cell border, over two laps: a round may end in the lap after its start.
        time = np.concatenate([[0.0], np.cumsum(np.tile(seconds, 2))])
        lap_s = time[len(seconds)]
        first = np.interp(starts * len(seconds), np.arange(len(time)), time)
        laps, rest = divmod(entry.frames / entry.frequency_hz, lap_s)
        spent = np.zeros((len(starts), len(tf.RoadClass)))
        for heading in tf.RoadClass:
            in_class = np.tile(seconds * lap.is_class[heading], 2)
            in_class = np.concatenate([[0.0], np.cumsum(in_class)])
            spent[:, heading] = (
                laps * in_class[len(seconds)]
                + np.interp(first + rest, time, in_class)
                - np.interp(first, time, in_class)
            )
        return np.asarray(spent / spent.sum(axis=1, keepdims=True))

    def with_fitting_traffic(self, entry: RoundPlan) -> RoundPlan:
        """Return the round `entry` with at most as many other cars as fit on its road."""
        most = most_cars(self._track(entry.track).length_m, entry.lanes)
        return replace(entry, traffic=min(entry.traffic, most))

    def _track(self, name: str) -> Track:
        return self._tracks[name] if name in self._tracks else random_track(name)

    def _lap_profile(self, name: str, lanes: int, lane_width_m: float) -> _LapProfile:
        track = self._track(name)
        profile = bend_profile(track, max_offset(Road(track, lanes, lane_width_m)))
        share = placement_share(track)
        placed = _is_class(track, len(share)) @ share
        is_class = _is_class(track, len(profile.limit))
        return _LapProfile(is_class, profile.limit, profile.cell_m, placed)


def _is_class(track: Track, cells: int) -> NDArray[np.bool_]:
    """Return a mask (3, cells) of the cells of a lap in which the road has each class."""
    s = (np.arange(cells) + 0.5) * (track.length_m / cells)
    here, ahead = track.at(s).curvature, track.at(s + tf.LOOK_AHEAD_M).curvature
    pairs = zip(here.tolist(), ahead.tolist(), strict=True)
    classes = np.array([tf.classify_heading(now, then) for now, then in pairs])
    return np.stack([classes == heading for heading in tf.RoadClass])


def expected_speed(entry: RoundPlan) -> float:
    """Return the expected speed (m/s) of the car of the round `entry` on a straight. Nobody can
    overtake on a one-lane road, so there the result is at most the expected speed of the slowest
    other car."""
    speed = entry.speed_kmh
    if entry.lanes == 1 and entry.traffic:
        low, high = DESIRED_KMH
        speed = min(speed, low + (high - low) / (entry.traffic + 1))
    return speed / KMH


def balance_starts(rounds: Sequence[RoundPlan], forecast: Forecast) -> tuple[RoundPlan, ...]:
    """Return the rounds with some starts changed so that no class is rare on any side of the
    split."""
    moved = list(rounds)
    for side in dict.fromkeys(entry.split for entry in moved):
        numbers = [i for i, entry in enumerate(moved) if entry.split == side]
        for i, start in _better_starts([moved[i] for i in numbers], forecast).items():
            moved[numbers[i]] = replace(moved[numbers[i]], start=start)
    return tuple(moved)


def expected_shares(rounds: Sequence[RoundPlan], forecast: Forecast) -> FloatArray:
    """Return the forecast shares (3,) of left, straight and right frames, over all frames of
    `rounds`."""
    each = np.array([forecast(entry, np.array([entry.start]))[0] for entry in rounds])
    return np.asarray(np.average(each, axis=0, weights=[entry.frames for entry in rounds]))


def _better_starts(rounds: Sequence[RoundPlan], forecast: Forecast) -> dict[int, float]:
    """Choose new starts with `forecast`, and return them by index in `rounds`. Each iteration makes
    the change with the greatest gain, until all classes reach `TARGET_SHARE` or no change gains
    more than `MIN_GAIN` requires."""
    shares = np.array([forecast(entry, np.array([entry.start]))[0] for entry in rounds])
    steps = np.arange(START_CANDIDATES) / START_CANDIDATES
    starts = [(entry.start + steps) % 1.0 for entry in rounds]
    options = np.array([forecast(e, tried) for e, tried in zip(rounds, starts, strict=True)])
    moved: dict[int, float] = {}
    while (missing := _missing_share(shares.mean(axis=0))) > 0.0:
        after = shares.mean(axis=0) + (options - shares[:, None]) / len(rounds)
        gain = missing - _missing_share(after)
        gain[list(moved)] = 0.0
        i, k = np.unravel_index(int(np.argmax(gain)), gain.shape)
        if gain[i, k] < MIN_GAIN / len(rounds):
            break
        shares[i] = options[i, k]
        moved[int(i)] = round(float(starts[int(i)][k]), 5)
    return moved


def _missing_share(shares: FloatArray) -> FloatArray:
    """Sum over the classes of the amounts by which `shares` (..., 3) are below `TARGET_SHARE`."""
    return np.asarray(np.maximum(TARGET_SHARE - shares, 0.0).sum(axis=-1))
