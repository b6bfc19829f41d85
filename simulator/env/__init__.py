"""The Gymnasium environments of the paper's lateral control task.

    import gymnasium
    import simulator.env  # registers the names

    gymnasium.make("driverview/LateralControl-v0", track="circuit", lanes=1, frequency_hz=20)
    gymnasium.make("driverview/DriverView-v0", track="forza", views=("front", "rear"))

One compiled call steps many cars in a vector environment (see `simulator.env.vector`):

    gymnasium.make_vec("driverview/LateralControl-v0", 256, "vector_entry_point", track="random")

The import of `simulator.env` is not needed with Gymnasium's syntax MODULE:NAME:

    gymnasium.make("simulator.env:driverview/LateralControl-v0")

An episode starts 25 m before the start line, at rest, unless the options of `reset` set "s",
"to_middle", "angle" or "speed". It terminates when the car leaves the track, drives backwards or
collides. It is truncated after 6500 steps (`max_episode_steps` of `gymnasium.make`).
"""

from collections.abc import Mapping
from typing import Any, ClassVar, NoReturn

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from simulator import register_environments
from simulator.env.action import action_space, to_command
from simulator.env.cars import Cars
from simulator.env.control_step import REWARD, SCORE
from simulator.env.errors import NotCopyable, ResetNeeded
from simulator.env.observation import Kind, Observation, Observer, read_from_beams
from simulator.env.options import OPTIONS, DriveOptions, split_options
from simulator.env.start import reset_options
from simulator.env.view_renderer import ViewRenderer
from simulator.world.fleet import COMMAND_AT
from simulator.world.world import World
from trackfeatures.errors import UserError

__all__ = ["OPTIONS", "DriveOptions", "DriverView", "LateralControl", "NotCopyable", "ResetNeeded"]
RENDERING = {"render_modes": ["rgb_array"], "render_fps": 20}


class LateralControl(gym.Env[Any, Any]):
    """Keep the car in the middle of the track: an environment that observes the car's state.

    The observation (7,) float32 is to_middle divided by half of the track's width, angle / pi, v_x
    and v_y divided by 75 km/h, and the class of the road one-hot (left, straight, right). The
    action is the steering in [-1, 1], left positive.

    Keyword arguments are the fields of DriveOptions, EpisodeOptions, ObservationOptions and
    RenderOptions, and `render_mode` ("rgb_array" or None). Raises UserError for options or actions
    out of their ranges, and ResetNeeded for a step before a reset or after the end of an episode.
    """

    # Gymnasium declares it as an instance attribute, but reads it from the class.
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
        drive, episode, observation, picture = split_options(
            {"track": track, "lanes": lanes} | options
        )
        observation = observation.resolved(self.kind)
        self._cars = Cars(
            [drive],
            episode,
            noise=observation.state_noise,
            limit=observation.limit,
            beams=any(map(read_from_beams, observation.sensors)),
        )
        self._renderer, self._render_view = (
            ViewRenderer(self.world.road, picture),
            picture.render_view,
        )
        self._observer = Observer(observation, self._renderer, self._cars.beams_of(0))
        self.render_mode = render_mode
        self.metadata = {**RENDERING, "render_fps": drive.frequency_hz}
        self._controls = drive.controls
        self.action_space: gym.Space[Any] = action_space(drive.controls)
        self.observation_space = self._observer.space
        self._running = False
        self._steps = 0

    @property
    def world(self) -> World:
        """The world of the current episode."""
        return self._cars.world(0)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        self._observer.restart(self._cars.reset(0, self.np_random, reset_options(options)))
        self._renderer.change_road(self.world.road)
        self._running = True
        self._steps = 0
        return self._observe()

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        if not self._running:
            raise ResetNeeded(
                "there is no episode to step in; call reset() before the first step, "
                "and after each episode"
            )
        command = to_command(action, self._controls)
        self._cars.fleet.cars[0, COMMAND_AT : COMMAND_AT + 4] = (
            *(command.steer, command.throttle),
            *(command.brake, command.gear),
        )
        self._cars.step((self.np_random,))
        ended = self._cars.ending(0) is not None
        self._running = not ended
        self._steps += 1
        observation, info = self._observe()
        return observation, float(self._cars.results[0, REWARD]), ended, False, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the picture (H, W, 3) of `render_view`, or None without a `render_mode`."""
        if self.render_mode is None:
            return None
        return self._renderer.render(self.world, (self._render_view,))[self._render_view]

    def calibration(self) -> dict[str, NDArray[np.float64]]:
        """Return `intrinsics` (3, 3) in px, and each view's `Camera.extrinsics` (4, 4) by its
        name."""
        return self._renderer.calibration(self._observer.views or (self._render_view,))

    def close(self) -> None:
        self._running = False
        self._renderer.close()
        self._cars.close()

    def __getstate__(self) -> NoReturn:
        # A copy would share the physics and graphics of the original.
        raise NotCopyable(
            "an environment cannot be copied or pickled; make another one with the same options, "
            "or pass a function that makes it"
        )

    def _observe(self) -> tuple[Observation, dict[str, Any]]:
        """Return the observation and the info of the current state."""
        cars, state = self._cars, self.world.state
        observation = self._observer.observe(self.world, cars.states[0].copy())
        return observation, {
            "score": float(cars.results[0, SCORE]),
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
            "ended": cars.ending(0) or "",
            "features": cars.features(0),
        }


class DriverView(LateralControl):
    """Keep the car in the middle of the track: an environment that observes the driver's view.

    Observation: {"image": (height, width, 3) uint8 RGB, "state": (7,) as in LateralControl}.
    """

    kind: ClassVar[Kind] = "dict"


register_environments()
