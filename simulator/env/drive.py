"""The episodes of one car. Its random generator determines road, car and start of each episode."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from simulator.env.options import DriveOptions, draw, ends_of
from simulator.env.start import check_start
from simulator.track.catalogue import find_track
from simulator.track.geometry import Track
from simulator.track.random_roads.kinds import least_width_m
from simulator.track.random_roads.road import RANDOM, random_name
from simulator.track.road import Road
from simulator.varied.road import make_road
from simulator.world.fleet import Fleet
from simulator.world.world import World, check_place

RANDOM_ROADS = 256
"""Number of roads of `track="random"`. Each road is built only once, because building it takes
about 30 ms."""


class RoadShop:
    """Builds each road once, for all cars that drive on it."""

    def __init__(self) -> None:
        self._tracks: dict[tuple[str, str | Path | None], Track] = {}
        self._roads: dict[tuple[Any, ...], Road] = {}

    def road(self, options: DriveOptions, track: str, lanes: int, width: float | None) -> Road:
        """Return the road with `lanes` lanes of `width` (m) on `track`, built at its first use.
        None for `width` is 4.0 m, or the random width of a road of `--roads varied`."""
        place = (track, options.tracks_dir)
        if place not in self._tracks:
            folder = None if options.tracks_dir is None else Path(options.tracks_dir)
            self._tracks[place] = find_track(track, folder)
        key = (*place, lanes, width, options.roads, options.road_seed)
        if key not in self._roads:
            self._roads[key] = make_road(
                self._tracks[place], lanes, width, options.roads, options.road_seed
            )
        return self._roads[key]


class Drive:
    """The world of car `number` of `fleet`; `reset` begins an episode.

    A reset that selects another road or car replaces the object `world`.
    """

    def __init__(self, options: DriveOptions, fleet: Fleet, number: int, roads: RoadShop) -> None:
        self._options, self._fleet, self._number, self._roads = options, fleet, number, roads
        self._draws_road = options.track == RANDOM or any(
            isinstance(value, tuple) for value in (options.lanes, options.lane_width)
        )
        self._draws_car = any(
            isinstance(value, tuple) for value in (options.friction, options.mass)
        )
        self._narrowest = self._narrowest_road()
        self.world = self._make_world(None)

    def reset(self, rng: np.random.Generator, given: Mapping[str, Any]) -> int:
        """Begin an episode with the `given` options of `reset`; returns the episode's seed."""
        start = self.check(given)
        episode = int(rng.integers(2**31))
        if self._draws_road or self._draws_car:
            self.world.close()
            self.world = self._make_world(rng)
        drawn = {name: draw(setting, rng) for name, setting in start.items()}
        self.world.reset(seed=episode, **check_start(drawn, self.world.road))
        return episode

    def check(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return the start of an episode: the start in the car's own options, overridden by the
        options `given` to `reset` that are not None. Ranges stay ranges. Raises UserError for an
        unknown option, a value that is not a number, or a start off the narrowest road that the
        options allow."""
        own = {name: value for name, value in given.items() if value is not None}
        start = {**self._options.start, **own}
        ranges = {name: ends_of(name, value) for name, value in start.items() if _is_range(value)}
        for end in (0, 1):
            values = {name: ranges[name][end] if name in ranges else start[name] for name in start}
            check_place(self._narrowest, **check_start(values, self._narrowest))
        return start

    def _make_world(self, rng: np.random.Generator | None) -> World:
        """Build the world with a road and a car that are random by `rng`. If `rng` is None, every
        random value is the least of its range."""
        options = self._options
        road, car = self._make_road(rng), options.car(rng)
        return World(
            road,
            traffic=options.traffic,
            frequency_hz=options.frequency_hz,
            car=car,
            fleet=self._fleet,
            number=self._number,
        )

    def _make_road(self, rng: np.random.Generator | None) -> Road:
        """Build the road of an episode, random by `rng`. If `rng` is None, every random value is
        the least of its range, and `track="random"` gives the first random road."""
        options, track, lanes = self._options, self._options.track, self._options.lanes
        if track == RANDOM:
            track = random_name(0 if rng is None else int(rng.integers(RANDOM_ROADS)))
        if isinstance(lanes, tuple):
            lanes = lanes[0] if rng is None else int(rng.integers(lanes[0], lanes[1] + 1))
        return self._roads.road(options, track, lanes, self._draw_width(rng))

    def _narrowest_road(self) -> Road:
        """Return the narrowest road that the options allow. For `track="random"` it is the first
        random road with the least width of a random road."""
        options, lanes = self._options, self._options.lanes
        least, greatest = lanes if isinstance(lanes, tuple) else (lanes, lanes)
        random = options.track == RANDOM
        track, width = random_name(0) if random else options.track, self._draw_width(None)
        counts = range(least, greatest + 1)
        roads = [self._roads.road(options, track, count, width) for count in counts]
        if random:
            narrow = replace(roads[0].track, width=least_width_m())
            roads = [replace(road, track=narrow) for road in roads]
        return min(roads, key=lambda road: road.edge)

    def _draw_width(self, rng: np.random.Generator | None) -> float | None:
        width = self._options.lane_width
        return round(draw(width, rng), 1) if isinstance(width, tuple) else width


def _is_range(setting: Any) -> bool:
    return isinstance(setting, tuple)
