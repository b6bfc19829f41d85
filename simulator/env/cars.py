"""The cars of an environment. One compiled call steps all of them, on one or more threads."""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.env.action import naming_car
from simulator.env.control_step import (
    DISTANCES_AT,
    ENDED,
    HEADING,
    RESULT,
    REWARD,
    SCORE,
    TO_LANE_CENTRE,
    observe_cars,
    step_cars,
)
from simulator.env.drive import Drive, RoadShop
from simulator.env.options import DriveOptions
from simulator.env.reward import ENDINGS, Ending, EpisodeOptions, ends_code
from simulator.sensors.beams import BEAM_ANGLES
from simulator.world.control_rate import PHYSICS_HZ
from simulator.world.fleet import DONE, SKIPPED, TOUCHED, Fleet
from simulator.world.world import World
from trackfeatures.definitions import MARKINGS
from trackfeatures.state_vector import STATE_SIZE

FEATURES = (*MARKINGS, "to_lane_centre")
"""Names of the features in the columns of `results` from DISTANCES_AT on (see `control_step`)."""


class Cars:
    """One car for each entry of `options`, and the outputs of the cars' last control step.

    `noise` is the standard deviation of the noise on the state vectors, and `limit` the bound to
    which their values are clipped. `beams` is whether the range beams are computed. At most
    `threads` threads step the cars. The outputs do not depend on the number of cars or threads.
    """

    def __init__(
        self,
        options: Sequence[DriveOptions],
        episode: EpisodeOptions,
        *,
        noise: float,
        limit: float,
        beams: bool,
        threads: int = 1,
    ) -> None:
        count, roads = len(options), RoadShop()
        self._steps = PHYSICS_HZ // options[0].frequency_hz
        self._episode, self._noise = episode, noise
        self.fleet = Fleet(count)
        self.drives: list[Drive] = []
        for number, drive in enumerate(options):
            with naming_car(number, count):
                self.drives.append(Drive(drive, self.fleet, number, roads))
        self._in_traffic = [number for number, drive in enumerate(options) if drive.traffic]
        self.states = np.zeros((count, STATE_SIZE), np.float32)
        self.results = np.zeros((count, RESULT))
        self.beams = np.zeros((count, len(BEAM_ANGLES) if beams else 0))
        self._added = np.zeros((count, STATE_SIZE if noise else 0))
        self._outputs = (self.states, self.results, self.beams, self._added)
        self._rules = (
            ends_code(episode.ends),
            episode.reward is None,
            float(episode.lambda_),
            limit,
            BEAM_ANGLES,
        )
        self._threads = _Threads(min(threads, count))
        self._everyone = np.ones(count, np.bool_)

    def world(self, number: int) -> World:
        return self.drives[number].world

    def beams_of(self, number: int) -> FloatArray | None:
        """Return the range beams (19,) of car `number` in m; None if they are not computed."""
        return self.beams[number] if self.beams.size else None

    def reset(self, number: int, rng: np.random.Generator, start: Mapping[str, Any]) -> int:
        """Begin an episode of car `number` at `start`, the options of `reset`. Returns the
        episode's seed."""
        seed = self.drives[number].reset(rng, start)
        self._draw_noise(number, rng)
        observe_cars(number, number + 1, self.fleet.arrays, self._outputs, self._rules, True)
        return seed

    def step(
        self,
        rngs: Sequence[np.random.Generator],
        moving: NDArray[np.bool_] | None = None,
    ) -> None:
        """Advance the cars that are `moving` (N,), by default all, by one control step. The row of
        each car in `fleet.cars` contains the command. `rngs` contains the generator of each car's
        noise."""
        moving = self._everyone if moving is None else moving
        rows = self.fleet.cars
        rows[:, TOUCHED], rows[:, DONE], rows[:, SKIPPED] = 0.0, 0.0, ~moving
        for number in self._in_traffic:
            if moving[number]:
                self.world(number).begin()
        if self._noise:
            for number in np.flatnonzero(moving).tolist():
                self._draw_noise(number, rngs[number])
        self._threads.run(
            step_cars, len(rows), self.fleet.arrays, self._steps, self._outputs, self._rules
        )
        for number in np.flatnonzero(moving & (rows[:, DONE] < self._steps)).tolist():
            with naming_car(number, len(rows)):
                self.world(number).complete()
            observe_cars(number, number + 1, self.fleet.arrays, self._outputs, self._rules, False)
        if self._episode.reward is not None:
            for number in np.flatnonzero(moving).tolist():
                with naming_car(number, len(rows)):
                    self._reward(number)

    def ending(self, number: int) -> Ending | None:
        """Return the event that ended the episode of car `number`; None if the episode
        continues."""
        code = int(self.results[number, ENDED])
        return ENDINGS[code - 1] if code else None

    def features(self, number: int) -> dict[str, float]:
        """Return the features of car `number` by name. Absent features have no entry, as Gymnasium
        requires."""
        row = self.results[number].tolist()
        found = dict(zip(FEATURES, row[DISTANCES_AT : TO_LANE_CENTRE + 1], strict=True))
        present = {name: value for name, value in found.items() if value == value}
        return present | {
            "angle": self.world(number).state.angle,
            "heading": int(row[HEADING]),
        }

    def close(self) -> None:
        self._threads.close()
        for drive in self.drives:
            drive.world.close()

    def _reward(self, number: int) -> None:
        world, result = self.world(number), self.results[number]
        result[REWARD] = self._episode.compute_reward(world.state, world.road, self.ending(number))
        result[SCORE] += result[REWARD]

    def _draw_noise(self, number: int, rng: np.random.Generator) -> None:
        if self._noise:
            self._added[number] = rng.normal(0.0, self._noise, size=STATE_SIZE)


class _Threads:
    """Runs a compiled function on several threads, each on a part of the cars."""

    def __init__(self, count: int) -> None:
        self._count = max(count, 1)
        self._pool: ThreadPoolExecutor | None = None
        self._owner = 0

    def run(self, function: Callable[..., None], cars: int, *arguments: Any) -> None:
        """Call `function(begin, end, *arguments)` for consecutive parts of `cars` cars."""
        if self._count == 1:
            function(0, cars, *arguments)
            return
        if self._pool is None or self._owner != os.getpid():  # threads do not survive a fork
            self._pool, self._owner = ThreadPoolExecutor(self._count - 1), os.getpid()
        bounds = [cars * k // self._count for k in range(self._count + 1)]
        waiting = [
            self._pool.submit(function, begin, end, *arguments)
            for begin, end in pairwise(bounds[1:])
        ]
        function(bounds[0], bounds[1], *arguments)
        for part in waiting:
            part.result()

    def close(self) -> None:
        if self._pool is not None and self._owner == os.getpid():
            self._pool.shutdown()
        self._pool = None
