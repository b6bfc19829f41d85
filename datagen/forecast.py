"""How often the road goes left, straight and right in a round that is only planned.

A round drives on from its start at the scripted speed, so the classes of its frames follow from
the track. What traffic costs on one lane is estimated; nothing is simulated.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.plan import RoundPlan, TrackChoice
from datagen.trajectory import reach
from simulator.speed import bend_profile
from simulator.track.catalogue import find_track
from simulator.track.geometry import Track
from simulator.track.road import Road
from simulator.traffic import DESIRED_KMH

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
