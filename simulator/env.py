"""The Gymnasium environments of the paper's lateral control task.

    import gymnasium
    import simulator.env  # registers the names

    gymnasium.make("driverview/LateralControl-v0", track="circuit", lanes=1, frequency_hz=20)
    gymnasium.make("driverview/DriverView-v0", track="forza", controls="full")

An episode starts 25 m before the line, at rest, unless `reset(options={"s", "to_middle", "angle",
"speed"})` says otherwise; it ends off the track, backwards or in a collision, and is cut after
6500 steps.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from simulator.car import HIGHEST_GEAR, LOWEST_GEAR
from simulator.registration import register_environments
from simulator.reward import ending, step_reward
from simulator.state import CarState, Command
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world import World
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from simulator.camera import Camera, Mount

Controls = Literal["steer", "full"]
Observation = dict[str, NDArray[Any]] | NDArray[Any]

THROTTLE, GEAR = 0.2, 1  # the paper holds both
SPEED_SCALE = 75.0 / 3.6  # m/s
NOISE = 0.05
"""Standard deviation of the paper's state noise."""
STATE_SIZE = 7
RENDERING = {"render_modes": ["rgb_array"], "render_fps": 20}
START_OPTIONS = ("s", "to_middle", "angle", "speed")


@dataclass(frozen=True)
class CameraOptions:
    """The picture of an environment; its scenery and light depend on `light_seed` only."""

    width: int = 280
    height: int = 210
    light: str = "clear"
    light_seed: int = 0
    mount: "Mount | None" = None


class LateralControl(gym.Env[Any, Any]):
    """Keep the car in the middle of the track, on its state.

    Observation (7,) float32: to_middle/w, angle/pi, v_x and v_y over 75 km/h, heading class
    one-hot (left, straight, right); with `noise` > 0 each gets N(0, noise^2), `noise=True` means
    the paper's 0.05. Action: steering in [-1, 1], left positive, throttle 0.2 and gear 1 held; with
    `controls="full"` steering, throttle, brake and gear (rounded). `lambda_` weighs the angle in
    the reward. Raises UserError for options or actions out of their ranges.
    """

    # Gymnasium types it as an instance's, but reads it off the class.
    metadata: dict[str, Any] = RENDERING

    def __init__(
        self,
        track: str = "circuit",
        lanes: int = 1,
        *,
        lane_width: float = tf.LANE_WIDTH_M,
        frequency_hz: int = 20,
        traffic: int = 0,
        noise: float | bool = 0.0,
        lambda_: float = 1.0,
        controls: Controls = "steer",
        tracks_dir: str | Path | None = None,
        render_mode: str | None = None,
        **camera: Any,
    ) -> None:
        if controls not in ("steer", "full"):
            raise UserError(f'controls is {controls!r}; choose "steer" or "full"')
        self._noise = NOISE if noise is True else float(noise)
        if not (math.isfinite(self._noise) and self._noise >= 0.0):
            raise UserError(f"noise is {noise}; give a standard deviation of 0 or more")
        if not math.isfinite(lambda_):
            raise UserError(f"lambda_ is {lambda_}; give a finite weight")
        if render_mode not in (None, "rgb_array"):
            raise UserError(f'render_mode is {render_mode!r}; choose "rgb_array" or leave it out')
        self._picture = _camera_options(camera)
        road = Road(
            find_track(track, None if tracks_dir is None else Path(tracks_dir)), lanes, lane_width
        )
        self.world = World(road, traffic=traffic, frequency_hz=frequency_hz)
        self.render_mode = render_mode
        self.metadata = {**RENDERING, "render_fps": frequency_hz}
        self._weight, self._full = float(lambda_), controls == "full"
        self._camera: Camera | None = None
        self._score, self._steps = 0.0, 0
        self.action_space: gym.Space[Any] = _action_space(self._full)
        self.observation_space = self._observation_space()

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        start = dict(options or {})
        unknown = sorted(set(start) - set(START_OPTIONS))
        if unknown:
            raise UserError(f"reset does not know the options {unknown}; it takes {START_OPTIONS}")
        episode = int(self.np_random.integers(2**31))
        state = self.world.reset(seed=episode, **start)
        self._score, self._steps = 0.0, 0
        return self._observe(state), self._info(state)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        state = self.world.step(self._command(action))
        ended = ending(state) is not None
        reward = step_reward(
            state.angle,
            state.to_middle,
            self.world.road.half_width,
            ended,
            self._weight,
        )
        self._score += reward
        self._steps += 1
        return self._observe(state), reward, ended, False, self._info(state)

    def render(self) -> NDArray[np.uint8] | None:
        """The driver's view (H, W, 3) with `render_mode="rgb_array"`, else None."""
        return self._image() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        self.world.close()

    def _observation_space(self) -> gym.Space[Any]:
        return gym.spaces.Box(-np.inf, np.inf, (STATE_SIZE,), np.float32)

    def _observe(self, state: CarState) -> Observation:
        return self._state_vector(state)

    def _state_vector(self, state: CarState) -> NDArray[np.float32]:
        heading = self.world.features().heading
        vector = np.zeros(STATE_SIZE)
        vector[0] = state.to_middle / self.world.road.half_width
        vector[1] = state.angle / math.pi
        vector[2] = state.vx / SPEED_SCALE
        vector[3] = state.vy / SPEED_SCALE
        vector[4 + int(heading)] = 1.0
        if self._noise:
            vector += self.np_random.normal(0.0, self._noise, size=STATE_SIZE)
        return vector.astype(np.float32)

    def _command(self, action: NDArray[np.float32]) -> Command:
        values = np.asarray(action, dtype=np.float64)
        size = 4 if self._full else 1
        if values.shape != (size,) or not np.all(np.isfinite(values)):
            raise UserError(
                f"the action is {action!r}; give {size} finite number(s), shape ({size},)"
            )
        if not self._full:
            return Command(steer=float(values[0]), throttle=THROTTLE, gear=GEAR)
        steer, throttle, brake, gear = values.tolist()
        return Command(steer=steer, throttle=throttle, brake=brake, gear=round(gear))

    def _info(self, state: CarState) -> dict[str, Any]:
        return {
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
            "ended": ending(state) or "",
        }

    def _image(self) -> NDArray[np.uint8]:
        if self._camera is None:
            self._camera = _make_camera(self.world.road, self._picture)
        image = self._camera.render(self.world.body_pose(), self.world.traffic.poses())
        return np.asarray(image, dtype=np.uint8)


class DriverView(LateralControl):
    """Keep the car in the middle on what the driver sees.

    Observation: {"image": (height, width, 3) uint8 RGB, "state": (7,) as in LateralControl}.
    Further options: `width`, `height`, `light` (a kind by name), `light_seed`, `mount`.
    """

    def _observation_space(self) -> gym.Space[Any]:
        shape = (self._picture.height, self._picture.width, 3)
        return gym.spaces.Dict(
            {
                "image": gym.spaces.Box(0, 255, shape, np.uint8),
                "state": super()._observation_space(),
            }
        )

    def _observe(self, state: CarState) -> Observation:
        return {"image": self._image(), "state": self._state_vector(state)}


def _camera_options(options: Mapping[str, Any]) -> CameraOptions:
    known = [field.name for field in fields(CameraOptions)]
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise UserError(f"the environment has no option {', '.join(unknown)}; cameras take {known}")
    from simulator.camera import check_light

    picture = CameraOptions(**options)
    check_light(picture.light)
    return picture


def _make_camera(road: Road, options: CameraOptions) -> "Camera":
    from simulator.camera import Camera, Light, Mount  # the renderer only where images are

    light = Light.named(options.light, np.random.default_rng([options.light_seed, 2]))
    return Camera(
        road,
        seed=options.light_seed,
        light=light,
        mount=options.mount or Mount(),
        width=options.width,
        height=options.height,
    )


def _action_space(full: bool) -> gym.Space[Any]:
    if not full:
        return gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    low = np.array([-1.0, 0.0, 0.0, LOWEST_GEAR], np.float32)
    return gym.spaces.Box(low, np.array([1.0, 1.0, 1.0, HIGHEST_GEAR], np.float32))


register_environments()
