"""The cars of a training in one vector environment, with random roads, cars and sensors.

A state is an array (N, size) for N cars. As in a drive, the lateral offset is divided by the same
half width on all roads: a controller does not know the width of the road. SI units, track frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from controllers.drive.config import THROTTLE
from controllers.drive.disturbance import ANGLE_NOISE_RAD, OFFSET_NOISE_M, SPEED_NOISE_M_S
from controllers.laws.actor_state import HISTORY, HISTORY_STEPS, StateDefinition, history_state
from controllers.rl import privileged
from controllers.rl.privileged import privileged_state
from simulator.env.reward import OFF_TRACK_REWARD, quadratic_reward
from simulator.env.vector import LateralControlVector
from simulator.track.catalogue import find_track
from simulator.track.random_roads.road import RANDOM
from trackfeatures.state_vector import SPEED_SCALE_M_S, STATE_SIZE

Array = NDArray[np.float32]

FRICTION, MASS = (0.8, 1.25), (0.85, 1.15)
"""Factors on the friction and the mass of disturbed cars."""
THROTTLES = (THROTTLE, 0.3)
"""Range of the throttle (0 to 1) of disturbed cars. With less than THROTTLE a car does not climb
alpine-2."""
DELAYS = 3
"""The perception of a disturbed car is 0 to DELAYS - 1 steps (of 50 ms) late."""
IMAGE_ERRORS = (0.022, 0.009)
"""Standard deviations (m, rad) of the errors of offset and angle in the model's answers during a
drive on images (docs/experiments/controllers.md). Unlike the noise of a disturbed car, they last
for several steps."""
IMAGE_ERROR_KEPT, IMAGE_ERROR_CORRELATION = 0.85, 0.6
"""Correlation of the errors on images with the errors one step earlier, and of the offset's error
with the angle's error."""
PERCEIVED = (0, 1, 4, 5, 6)
"""Indices of the numbers in the paper's state that the perception measures. The car's speeds are
measured without delay."""
EPISODE_STEPS = (200, 800)  # least and greatest number of control steps of an episode
STANDING = 0.4
"""Share of the cars that start at rest; all other cars start in motion."""
START = {"to_middle": (-2.0, 2.0), "angle": (-0.12, 0.12)}  # ranges, m and rad
START_SPEED = (0.0, 18.0)  # range, m/s
GOLDEN_RATIO = 0.5 * (5.0**0.5 - 1.0)
"""Multiples of the golden ratio modulo 1 are spread evenly between 0 and 1, for any number of
tracks. They determine on which tracks the cars are disturbed."""
RANDOM_START_M = 3000.0
"""On random roads, which differ in length, the start is 0 to RANDOM_START_M (m) along the road."""


@dataclass(frozen=True)
class Step:
    """The result of a control step of N cars."""

    last: Array  # (N, size), the states after the step
    states: Array  # (N, size), as `last`, but the first states of cars in new episodes
    privileged: Array  # (N, privileged.SIZE), `privileged_state` before the step
    last_privileged: Array  # (N, privileged.SIZE), `privileged_state` after the step
    rewards: NDArray[np.float64]  # (N,)
    ended: NDArray[np.bool_]  # (N,), whether the episode reached a terminal state
    over: NDArray[np.bool_]  # (N,), whether the episode ended, also by its number of steps
    offsets_m: NDArray[np.float64]  # (N,), from the middle of the road, left positive


class Cars:
    """N cars on `tracks` (N names). The cars whose element of `disturbed` (N,) is True get new
    random parameters, noise and delay in each episode.

    `starts`: values of the start by name, each fixed or a range, for the environment's reset.
    `episode`: least and greatest number of steps of an episode. `half_width_m`: divisor of the
    lateral offset. `image_errors`: whether the states of all cars that are not disturbed have
    errors like the errors of the model's answers to images (`IMAGE_ERRORS`).
    """

    def __init__(
        self,
        definition: StateDefinition,
        tracks: Sequence[str],
        disturbed: NDArray[np.bool_],
        *,
        starts: dict[str, Any],
        episode: tuple[int, int],
        half_width_m: float,
        reward: str = "paper",
        state_noise: float = 0.0,
        image_errors: bool = False,
        threads: int = 1,
        tracks_dir: Path | None = None,
    ) -> None:
        self.count = len(tracks)
        self._history = definition.name == HISTORY.name
        self._disturbed, self._episode = disturbed, episode
        self._half_width_m, self._quadratic = half_width_m, reward == "quadratic"
        self._state_noise = state_noise
        self._on_images = ~disturbed if image_errors else np.zeros(self.count, np.bool_)
        drawn: dict[str, Any] = {
            name: [range_ if one else 1.0 for one in disturbed.tolist()]
            for name, range_ in (("friction", FRICTION), ("mass", MASS))
        }
        self._envs = LateralControlVector(
            self.count,
            list(tracks),
            controls="full",
            autoreset_mode=AutoresetMode.DISABLED,
            max_episode_steps=None,
            threads=threads,
            start=starts,
            tracks_dir=tracks_dir,
            **drawn,
        )
        self._actions = np.zeros((self.count, 4))
        self._actions[:, 3] = 1.0
        self._left = np.zeros(self.count, np.int64)
        self._delay = np.zeros(self.count, np.int64)
        self._noise = np.zeros(self.count)
        self._image_errors = np.zeros((self.count, 2), np.float32)
        self._late = np.zeros((DELAYS, self.count, STATE_SIZE), np.float32)
        self._recent = np.zeros((self.count, HISTORY_STEPS, STATE_SIZE), np.float32)
        self._everyone = np.ones(self.count, np.bool_)
        self._privileged = np.zeros((self.count, privileged.SIZE), np.float32)

    def reset(self, seed: int) -> Array:
        """Begin an episode of each car; return the first states (N, size). All later steps depend
        only on `seed` and the actions."""
        self._rng = np.random.default_rng(seed)
        observed, info = self._envs.reset(seed=seed)
        self._begin(self._everyone)
        self._privileged = self._exact()
        return self._perceive(observed, info, self._everyone)

    def step(self, steering: Array) -> Step:
        """Advance all cars by a control step with `steering` (N,) in [-1, 1]."""
        self._actions[:, 0] = steering
        observed, rewards, ended, _, info = self._envs.step(self._actions)
        offsets, none = info["to_middle"], np.zeros(self.count, np.bool_)
        if self._quadratic:
            steers: Any = self._actions[:, 0]  # the formula also accepts arrays
            running = quadratic_reward(offsets, info["angle"], steers, False)
            rewards = np.where(ended, OFF_TRACK_REWARD, running)
        last = states = self._perceive(observed, info, none)
        before, self._privileged = self._privileged, self._exact()
        after = self._privileged
        self._left -= 1
        over = ended | (self._left <= 0)
        if over.any():
            observed, info = self._envs.reset(options={"reset_mask": over})
            self._begin(over)
            states = np.where(over[:, None], self._perceive(observed, info, over), last)
            self._privileged = np.where(over[:, None], self._exact(), after)
        return Step(last, states, before, after, rewards, ended, over, offsets)

    def close(self) -> None:
        self._envs.close()

    def _exact(self) -> Array:
        throttle, fleet = self._actions[:, 1], self._envs.fleet
        noise = np.where(self._on_images, 1.0, self._noise)
        return privileged_state(fleet, throttle, self._delay, noise)

    def _begin(self, new: NDArray[np.bool_]) -> None:
        """Set random throttle, delay, noise and length of the episodes of the `new` cars (N,)."""
        low, high = self._episode
        lengths = self._rng.integers(low, high, self.count, endpoint=True)
        throttles = self._rng.uniform(*THROTTLES, self.count)
        delays = self._rng.integers(DELAYS, size=self.count)
        noises = self._rng.uniform(0.0, 1.0, self.count)
        of = self._disturbed
        self._left = np.where(new, lengths, self._left)
        self._actions[new, 1] = np.where(of, throttles, THROTTLE)[new]
        self._delay[new] = np.where(of, delays, 0)[new]
        self._noise[new] = np.where(of, noises, 0.0)[new]

    def _perceive(self, observed: Array, info: dict[str, Any], new: NDArray[np.bool_]) -> Array:
        """Return the states (N, size) with delay and noise. `observed` (N, 7) is the observation of
        the environment and `info` its additional output.

        `new` (N,) marks cars in new episodes: their memory of earlier steps is filled with their
        present state. If any car is new, only the states of new cars are valid, and the memory of
        all other cars is unchanged.
        """
        exact = observed.copy()
        exact[:, 0] = info["to_middle"] / self._half_width_m
        if new.any():
            self._late[:, new] = exact[new]
        else:
            self._late[1:] = self._late[:-1].copy()
            self._late[0] = exact
        seen = exact
        seen[:, PERCEIVED] = self._late[self._delay, np.arange(self.count)][:, PERCEIVED]
        self._add_noise(seen)
        if self._on_images.any():
            seen[:, :2] += self._next_image_errors(new)
        if not self._history:
            return seen
        if new.any():
            self._recent[new] = seen[new, None]
        else:
            self._recent[:, 1:] = self._recent[:, :-1].copy()
            self._recent[:, 0] = seen
        return history_state(self._recent)

    def _add_noise(self, seen: Array) -> None:
        if self._state_noise:
            seen += self._rng.normal(0.0, self._state_noise, seen.shape)
        if self._disturbed.any():
            spread = (
                *(OFFSET_NOISE_M / self._half_width_m, ANGLE_NOISE_RAD / np.pi),
                *(SPEED_NOISE_M_S / SPEED_SCALE_M_S,) * 2,
            )
            drawn = self._rng.standard_normal((self.count, 4), np.float32)
            seen[:, :4] += drawn * (self._noise[:, None] * spread).astype(np.float32)

    def _next_image_errors(self, new: NDArray[np.bool_]) -> Array:
        """Return the errors (N, 2) of offset and angle in this step, in the units of the state. The
        errors are 0 for cars without image errors. Each error is a first-order autoregressive
        process; the process starts anew for the `new` cars (N,)."""
        drawn = self._rng.standard_normal((self.count, 2), np.float32)
        shared, kept = np.float32(IMAGE_ERROR_CORRELATION), np.float32(IMAGE_ERROR_KEPT)
        drawn[:, 1] = shared * drawn[:, 0] + np.sqrt(1 - shared**2) * drawn[:, 1]
        if new.any():
            self._image_errors[new] = drawn[new]
        else:
            self._image_errors = kept * self._image_errors + np.sqrt(1 - kept**2) * drawn
        unit = np.array(IMAGE_ERRORS) / (self._half_width_m, np.pi)
        found: Array = self._image_errors * (self._on_images[:, None] * unit).astype(np.float32)
        return found


def random_cars(
    definition: StateDefinition,
    count: int,
    tracks: Sequence[str],
    disturbed: float,
    **options: Any,
) -> Cars:
    """Make `count` cars that start at random positions and speeds.

    With several `tracks` every second car drives on a random road; the other cars drive on the
    tracks in turn. With one track all cars drive on it. `disturbed`: share of the disturbed cars,
    evenly spread over the tracks. `options`: further arguments of `Cars`.
    """
    several = len(tracks) > 1
    pairs = np.arange(count) // (2 if several else 1)
    chosen = [
        RANDOM if several and number % 2 else tracks[pair % len(tracks)]
        for number, pair in enumerate(pairs.tolist())
    ]
    ranks = np.argsort(np.argsort(np.unique(pairs) * GOLDEN_RATIO % 1.0))
    disturbs = (ranks < disturbed * len(ranks))[pairs]
    folder = options.get("tracks_dir")
    lengths = {name: find_track(name, folder).length_m for name in set(chosen) - {RANDOM}}
    standing = np.random.default_rng(count).random(count) < STANDING
    starts = START | {
        "s": [(0.0, lengths.get(name, RANDOM_START_M)) for name in chosen],
        "speed": [0.0 if still else START_SPEED for still in standing.tolist()],
    }
    return Cars(definition, chosen, disturbs, starts=starts, episode=EPISODE_STEPS, **options)
