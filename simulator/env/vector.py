"""Many cars in one vector environment: `gymnasium.make_vec` with "vector_entry_point".

    envs = gymnasium.make_vec(
        "driverview/LateralControl-v0", num_envs=256, vectorization_mode="vector_entry_point",
        track="random", friction=(0.8, 1.2), start={"s": (0.0, 1000.0)},
    )

Each car gives the same numbers, bit for bit, as a single environment with the same options and
seed. Worker processes draw the pictures.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from simulator import MAX_STEPS
from simulator.bounds import check_whole
from simulator.env.action import action_space, naming_car, to_rows
from simulator.env.cars import Cars
from simulator.env.control_step import ENDED, REWARD
from simulator.env.errors import NotCopyable, ResetNeeded
from simulator.env.observation import Kind, read_from_beams
from simulator.env.options import DriveOptions, split_options
from simulator.env.start import reset_options
from simulator.env.vector_info import vector_info
from simulator.env.vector_observer import VectorObserver
from simulator.env.vector_pictures import checked_workers
from simulator.env.view_renderer import RenderOptions
from simulator.world.fleet import COMMAND_AT, STEPS, Fleet
from simulator.world.world import World
from trackfeatures.errors import UserError

LOOK = ("light", "light_seed")
PER_CAR = (
    *("track", "lanes", "lane_width", "roads", "road_seed"),
    *("traffic", "friction", "mass", "start", *LOOK),
)
"""Options that may be lists with one entry for each car."""
CARS_PER_THREAD = 32
"""Least number of cars per thread; with fewer cars an additional thread saves no time."""
MASK = "reset_mask"
Seeds = int | Sequence[int | None] | NDArray[np.integer[Any]] | None
"""One seed, to which each car adds its number, or a list with one seed for each car."""
Options = TypeVar("Options", DriveOptions, RenderOptions)


class LateralControlVector(gym.vector.VectorEnv[Any, Any, NDArray[Any]]):
    """`num_envs` cars; each behaves like the car of one `LateralControl`.

    The options are those of `LateralControl`. The options for road, traffic, friction, mass, start
    and light (PER_CAR), and each entry of `start`, are one value for all cars or a list with one
    value for each car. `lanes`, `lane_width`, `friction`, `mass` and the entries of `start` can be
    ranges (least, greatest), from which each episode draws a number. At most `threads` threads step
    the cars; None gives one per core, with at least 32 cars per thread. `workers` processes draw
    the pictures; None gives one per core. If `copy` is False, the pictures of an observation are
    arrays in memory shared with the workers, and the next `step` or `reset` overwrites them.

    Raises UserError, which names the car, for bad options and actions; then no car has moved.
    Raises PictureWorkerError if a worker dies; `reset` starts new workers.
    """

    kind: ClassVar[Kind] = "state"

    def __init__(
        self,
        num_envs: int = 1,
        track: str | Sequence[str] = "circuit",
        lanes: int | tuple[int, int] | Sequence[int | tuple[int, int]] = 1,
        *,
        render_mode: str | None = None,
        max_episode_steps: int | None = MAX_STEPS,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
        workers: int | None = None,
        copy: bool = True,
        **options: Any,
    ) -> None:
        num_envs = check_whole("num_envs", num_envs, 1)
        for name, value in (("threads", threads), ("max_episode_steps", max_episode_steps)):
            if value is not None:
                check_whole(name, value, 1)
        if not isinstance(copy, bool):
            raise UserError(f"copy is {copy!r}; give True or False")
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        if render_mode not in (None, "rgb_array"):
            raise UserError(f'render_mode is {render_mode!r}; choose "rgb_array" or leave it out')
        given = {"track": track, "lanes": lanes} | options
        listed, shared = _options_by_car(given, num_envs)
        looks = {name: listed.pop(name) for name in LOOK if name in listed}
        drive, episode, observation, picture = split_options(shared)
        observation = observation.resolved(self.kind)
        self._cars = Cars(
            _with_lists(drive, listed, num_envs),
            episode,
            noise=observation.state_noise,
            limit=observation.limit,
            beams=any(map(read_from_beams, observation.sensors)),
            threads=threads or _default_threads(num_envs),
        )
        self.num_envs, self.render_mode = num_envs, render_mode
        self._observer = VectorObserver(
            self._cars,
            observation,
            _with_lists(picture, looks, num_envs),
            render_view=picture.render_view if render_mode else None,
            workers=checked_workers(workers, num_envs),
            copy=copy,
        )
        self._frequency_hz, self._controls = drive.frequency_hz, drive.controls
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": drive.frequency_hz,
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_action_space = action_space(drive.controls)
        self.single_observation_space = self._observer.single_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = self._observer.space
        self._rngs: list[np.random.Generator] = []
        self._max_steps = max_episode_steps or np.inf
        self._over = np.zeros(num_envs, np.bool_)

    def world(self, number: int) -> World:
        """Return the world of the current episode of car `number`."""
        return self._cars.world(number)

    @property
    def fleet(self) -> Fleet:
        """All cars and their roads as arrays; `step` and `reset` overwrite them."""
        return self._cars.fleet

    def reset(
        self,
        *,
        seed: Seeds = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode of each car, or of the cars in the mask `options["reset_mask"]` (N,)
        bool; returns the observations of all cars, and infos of the cars that were reset. "s",
        "to_middle", "angle" and "speed" are a number, a list with one value for each car, or a
        range (least, greatest)."""
        if self.closed:
            raise UserError("this environment is closed; make a new one")
        given = reset_options(options)
        chosen = self._mask(given.pop(MASK, None))
        seeds, starts = self._seeds(seed), self._starts(given)
        for number in np.flatnonzero(chosen).tolist():
            with naming_car(number, self.num_envs):
                self._cars.drives[number].check(starts[number])
        if not self._rngs:
            self._rngs = [seeding.np_random()[0] for _ in range(self.num_envs)]
        for number in np.flatnonzero(chosen).tolist():
            if seeds[number] is not None:
                self._rngs[number] = seeding.np_random(seeds[number])[0]
            self._reset(number, starts[number])
        self._over[chosen] = False
        return self._observe(chosen), self._info(chosen)

    def step(
        self, actions: Any
    ) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Advance all cars by one control step with `actions` (N, 1) or (N, 4). Cars whose episode
        has ended are reset according to the autoreset mode. Returns observations, rewards (N,),
        terminated (N,), truncated (N,) and info."""
        self._check_running()
        moving = ~self._over
        rows = to_rows(actions, self._controls, moving)
        for number in np.flatnonzero(self._over).tolist():
            self._reset(number, {})
        cars = self._cars
        cars.fleet.cars[moving, COMMAND_AT : COMMAND_AT + 4] = rows[moving]
        cars.step(self._rngs, moving)
        rewards = cars.results[:, REWARD].copy()
        terminated = cars.results[:, ENDED] > 0.0
        truncated = moving & (cars.fleet.cars[:, STEPS] >= self._max_steps)
        self._over = terminated | truncated
        everyone = np.ones(self.num_envs, np.bool_)
        observed = self._observe(everyone)
        if self.autoreset_mode != AutoresetMode.SAME_STEP or not self._over.any():
            return observed, rewards, terminated, truncated, self._info(everyone)
        last = self._last(observed)
        for number in np.flatnonzero(self._over).tolist():
            self._reset(number, {})
        observed = self._observe(self._over)
        self._over = np.zeros(self.num_envs, np.bool_)
        return observed, rewards, terminated, truncated, self._info(everyone) | last

    def render(self) -> tuple[Any, ...]:
        """Return each car's `render_view` (H, W, 3), or Nones without a `render_mode`."""
        return self._observer.frames() if self.render_mode else (None,) * self.num_envs

    def close_extras(self, **kwargs: Any) -> None:
        self._rngs = []
        self._observer.close()
        self._cars.close()

    def __getstate__(self) -> Any:
        raise NotCopyable(
            "an environment cannot be copied or pickled; make another one with the same options, "
            "or pass a function that makes it"
        )

    def _reset(self, number: int, start: Mapping[str, Any]) -> None:
        with naming_car(number, self.num_envs):
            episode = self._cars.reset(number, self._rngs[number], start)
        self._observer.restart(number, episode)

    def _observe(self, chosen: NDArray[np.bool_]) -> Any:
        """Observe the `chosen` cars (N,) again; returns the observations of all cars."""
        try:
            return self._observer.observe(chosen)
        except BaseException:  # the cars have moved, but nothing has been returned
            self._rngs = []
            raise

    def _info(self, chosen: NDArray[np.bool_]) -> dict[str, Any]:
        return vector_info(self._cars, self._frequency_hz, chosen)

    def _last(self, observed: Any) -> dict[str, Any]:
        """Return what same-step mode adds to `info` for the cars whose episode has ended."""
        observations = np.full(self.num_envs, None, object)
        for number in np.flatnonzero(self._over).tolist():
            observations[number] = (
                {name: part[number].copy() for name, part in observed.items()}
                if isinstance(observed, dict)
                else observed[number].copy()
            )
        over = self._over.copy()
        return {
            "final_obs": observations,
            "_final_obs": over,
            "final_info": self._info(over),
            "_final_info": over,
        }

    def _check_running(self) -> None:
        if not self._rngs:
            raise ResetNeeded("there are no episodes to step in; call reset() first")
        if self.autoreset_mode == AutoresetMode.DISABLED and self._over.any():
            cars = ", ".join(map(str, np.flatnonzero(self._over)))
            raise ResetNeeded(
                f'the episodes of cars {cars} are over; call reset(options={{"reset_mask": ...}}), '
                "or choose another autoreset_mode"
            )

    def _mask(self, mask: Any) -> NDArray[np.bool_]:
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        found = np.asarray(mask)
        if found.shape != (self.num_envs,) or found.dtype != np.bool_ or not found.any():
            raise UserError(
                f"reset_mask has shape {found.shape} and type {found.dtype}; give an array of "
                f"{self.num_envs} truth values, at least one of them True"
            )
        if not self._rngs and not found.all():
            raise ResetNeeded("the first reset must reset all cars; leave reset_mask out")
        return found

    def _seeds(self, seed: Seeds) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if not isinstance(seed, list | tuple | np.ndarray):
            return [check_whole("seed", seed) + number for number in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise UserError(
                f"seed is a list of {len(seed)} for {self.num_envs} cars; give one for each, or "
                "one whole number"
            )
        seeds = []
        for number, own in enumerate(seed):
            with naming_car(number, self.num_envs):
                seeds.append(None if own is None else check_whole("seed", own))
        return seeds

    def _starts(self, given: dict[str, Any]) -> list[dict[str, Any]]:
        listed, shared = _lists(given, self.num_envs)
        return [shared | own for own in _of_each_car(listed, self.num_envs)]


def _with_lists(shared: Options, listed: dict[str, list[Any]], count: int) -> list[Options]:
    """Return the options of each car: `shared`, with the car's entry of each list."""
    options = []
    for number, own in enumerate(_of_each_car(listed, count)):
        with naming_car(number, count):
            options.append(replace(shared, **own) if own else shared)
    return options


def _of_each_car(listed: dict[str, list[Any]], count: int) -> list[dict[str, Any]]:
    return [{name: values[k] for name, values in listed.items()} for k in range(count)]


def _options_by_car(
    given: dict[str, Any], count: int
) -> tuple[dict[str, list[Any]], dict[str, Any]]:
    """Split the options `given` into lists with a value for each of `count` cars, and values that
    all cars share."""
    listed, own = _lists({name: given[name] for name in PER_CAR if name in given}, count)
    shared = {name: value for name, value in given.items() if name not in PER_CAR} | own
    if isinstance(shared.get("start"), Mapping):
        starts, start = _lists(dict(shared["start"]), count)
        if starts:
            listed["start"] = [start | own for own in _of_each_car(starts, count)]
            del shared["start"]
    return listed, shared


def _lists(given: dict[str, Any], count: int) -> tuple[dict[str, list[Any]], dict[str, Any]]:
    """Split `given` into lists with one value for each car, and values shared by all cars."""
    listed, shared = {}, {}
    for name, value in given.items():
        if isinstance(value, np.ndarray):
            value = value.tolist()
        if not isinstance(value, list):
            shared[name] = value
            continue
        if len(value) != count:
            raise UserError(
                f"{name} is a list of {len(value)} for {count} cars; give one entry for each car, "
                "or one value for all"
            )
        listed[name] = value
    return listed, shared


class DriverViewVector(LateralControlVector):
    """`num_envs` cars; each behaves like the car of one `DriverView`."""

    kind: ClassVar[Kind] = "dict"


def _autoreset_mode(given: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(given)
    except ValueError:
        raise UserError(
            f"autoreset_mode is {given!r}; choose NextStep, SameStep or Disabled"
        ) from None


def _default_threads(count: int) -> int:
    return max(1, min(len(os.sched_getaffinity(0)), count // CARS_PER_THREAD))
