"""The Gymnasium environments of the paper's lateral control task.

    import gymnasium
    import simulator.env  # registers the names

    gymnasium.make("driverview/LateralControl-v0", track="circuit", lanes=1, frequency_hz=20)
    gymnasium.make("driverview/DriverView-v0", track="forza", views=("front", "rear"))

or, without the second import, by Gymnasium's own syntax for names that a module registers:

    gymnasium.make("simulator.env:driverview/LateralControl-v0")

An episode starts 25 m before the line, at rest, unless `reset(options={"s", "to_middle", "angle",
"speed"})` sets another start. It terminates off the track, backwards or in a collision, and is
truncated after 6500 steps (`max_episode_steps` of `gymnasium.make`).
"""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from simulator import register_environments
from simulator.env.action import Controls, action_space, check_controls, to_command
from simulator.env.observation import Kind, Observation, ObservationOptions, Observer
from simulator.env.reward import Ending, EpisodeOptions
from simulator.env.start import check_start
from simulator.env.view_renderer import RenderOptions, ViewRenderer
from simulator.track.catalogue import find_track
from simulator.varied.road import make_road
from simulator.vehicle.state import CarState
from simulator.world.world import World
from trackfeatures.errors import UserError

RENDERING = {"render_modes": ["rgb_array"], "render_fps": 20}


class ResetNeeded(UserError, gym.error.ResetNeeded):
    """`step` was called before `reset` or after the end of an episode."""


class NotCopyable(UserError, TypeError):
    """An environment cannot be copied or pickled."""


@dataclass(frozen=True)
class DriveOptions:
    """The road, its traffic and the controls."""

    track: str = "circuit"
    lanes: int = 1
    lane_width: float | None = None
    """m; None: 4.0, or the width drawn for a varied road."""
    roads: str = "paper"
    """"varied": lane width, shoulders and lines are drawn from `road_seed`, the look from
    `light_seed`."""
    road_seed: int = 0
    traffic: int = 0
    """Other cars, 0 to 12."""

    frequency_hz: int = 20
    """Control steps per second; must divide the physics' 200 Hz."""

    controls: Controls = "steer"
    """"steer": steering only, at throttle 0.2 in gear 1; "full": steering, throttle, brake and
    gear."""

    tracks_dir: str | Path | None = None
    """A further folder to search for tracks."""

    def __post_init__(self) -> None:
        check_controls(self.controls)


OPTIONS = (DriveOptions, EpisodeOptions, ObservationOptions, RenderOptions)


class LateralControl(gym.Env[Any, Any]):
    """Keep the car in the middle of the track, from its state.

    Observation (7,) float32: to_middle/w, angle/pi, v_x and v_y over 75 km/h, heading class
    one-hot (left, straight, right). Action: steering in [-1, 1], left positive.

    Keyword arguments are the fields of DriveOptions, EpisodeOptions, ObservationOptions and
    RenderOptions, and `render_mode` ("rgb_array" or None). Raises UserError for options or actions
    out of their ranges, ResetNeeded for a step before a reset or after the end of an episode.
    """

    # Gymnasium types it as an instance attribute, but reads it from the class.
    metadata: dict[str, Any] = RENDERING
    kind: ClassVar[Kind] = "state"

    def __init__(
        self,
        track: str = "circuit",
        lanes: int = 1,
        *,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UserError(f'render_mode is {render_mode!r}; choose "rgb_array" or leave it out')
        drive, self._episode, observation, picture = _split_options(
            {"track": track, "lanes": lanes} | options
        )
        tracks_dir = None if drive.tracks_dir is None else Path(drive.tracks_dir)
        found = find_track(drive.track, tracks_dir)
        road = make_road(found, drive.lanes, drive.lane_width, drive.roads, drive.road_seed)
        self._renderer, self._render_view = ViewRenderer(road, picture), picture.render_view
        self._observer = Observer(observation.resolved(self.kind), self._renderer)
        self.world = World(road, traffic=drive.traffic, frequency_hz=drive.frequency_hz)
        self.render_mode = render_mode
        self.metadata = {**RENDERING, "render_fps": drive.frequency_hz}
        self._controls = drive.controls
        self.action_space: gym.Space[Any] = action_space(drive.controls)
        self.observation_space = self._observer.space
        self._running = False
        self._score, self._steps = 0.0, 0

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        start = check_start(options or {}, self.world.road)
        episode = int(self.np_random.integers(2**31))
        state = self.world.reset(seed=episode, **start)
        self._observer.restart(episode)
        self._running = True
        self._score, self._steps = 0.0, 0
        return self._observe(state, None)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        if not self._running:
            raise ResetNeeded(
                "there is no episode to step in; call reset() before the first step, "
                "and after each episode"
            )
        state = self.world.step(to_command(action, self._controls))
        ending = self._episode.ending(state)
        reward = self._episode.compute_reward(state, self.world.road, ending)
        self._running = ending is None
        self._score += reward
        self._steps += 1
        observation, info = self._observe(state, ending)
        return observation, reward, ending is not None, False, info

    def render(self) -> NDArray[np.uint8] | None:
        """`render_view` (H, W, 3) with `render_mode="rgb_array"`, else None."""
        if self.render_mode is None:
            return None
        return self._renderer.render(self.world, (self._render_view,))[self._render_view]

    def calibration(self) -> dict[str, NDArray[np.float64]]:
        """`intrinsics` (3, 3) in pixels, and each view's `Camera.extrinsics` (4, 4) by its name."""
        return self._renderer.calibration(self._observer.views or (self._render_view,))

    def close(self) -> None:
        self._running = False
        self._renderer.close()
        self.world.close()

    def __getstate__(self) -> NoReturn:
        # A copy would share the physics and graphics of the original.
        raise NotCopyable(
            "an environment cannot be copied or pickled; make another one with the same options, "
            "or pass a function that makes it"
        )

    def _observe(
        self, state: CarState, ending: Ending | None
    ) -> tuple[Observation, dict[str, Any]]:
        features = self.world.features()
        observation = self._observer.observe(self.world, features, self.np_random)
        return observation, {
            "score": self._score,
            "steps": self._steps,
            "time_s": state.time_s,
            "lap": state.lap,
            "lap_time_s": state.lap_time_s,
            "s": state.s,
            "to_middle": state.to_middle,
            "angle": state.angle,
            "speed_kmh": state.speed_kmh,
            "rpm": state.rpm,
            "collision": state.collision or "",
            "ended": ending or "",
            "features": _feature_values(features),
        }


class DriverView(LateralControl):
    """Keep the car in the middle of the track, from the driver's camera view.

    Observation: {"image": (height, width, 3) uint8 RGB, "state": (7,) as in LateralControl}.
    """

    kind: ClassVar[Kind] = "dict"


def _split_options(
    given: dict[str, Any],
) -> tuple[DriveOptions, EpisodeOptions, ObservationOptions, RenderOptions]:
    """The four groups of options from keyword arguments. Raises UserError for an unknown one."""
    names = [field.name for group in OPTIONS for field in fields(group)]
    for name in given:
        if name not in names:
            close = difflib.get_close_matches(name, names, 1)
            hint = f"did you mean {close[0]!r}?" if close else f"it takes {', '.join(names)}"
            raise UserError(f"the environment has no option {name!r}; {hint}")
    drive, episode, observation, picture = (
        {field.name: given[field.name] for field in fields(group) if field.name in given}
        for group in OPTIONS
    )
    return (
        DriveOptions(**drive),
        EpisodeOptions(**episode),
        ObservationOptions(**observation),
        RenderOptions(**picture),
    )


def _feature_values(features: tf.TrackFeatures) -> dict[str, float]:
    """The features that are present; absent ones are left out, as Gymnasium's vectors expect."""
    given = features.distances | {"to_lane_centre": features.to_lane_centre}
    present = {name: value for name, value in given.items() if value is not None}
    return present | {"angle": features.angle, "heading": int(features.heading)}


register_environments()
