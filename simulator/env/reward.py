"""The reward of a control step, the events that end an episode, and the options for both.

`step_reward` is the formula in the paper's section on the RL control module, with one difference:
the paper divides the lateral offset by half of the lane's width, this code by half of the track's
width. `quadratic_reward` is the paper's second reward.
"""

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from runtime.jit import callable_from_compiled, compiled
from simulator.track.road import Road
from simulator.vehicle.car import CarParameters
from simulator.vehicle.state import CarState
from trackfeatures.errors import UserError

Ending = Literal["off_track", "backwards", "collision"]

ENDINGS: tuple[Ending, ...] = get_args(Ending)
OFF_TRACK_REWARD = -2.0
STEERING_LOCK = CarParameters.steering_lock

Reward = Callable[[CarState, Road, Ending | None], float]
"""A function of the state after the step, the road, and the event that ends the episode or None."""


@compiled
def ending_code(off_track: bool, backwards: bool, wall: bool, touched: bool, ends: int) -> int:
    """Return 1 + the index into ENDINGS of the event that ends an episode; 0 if it continues.

    off_track, backwards: the car is off the track, or drives backwards; wall: it touches a wall;
    touched: it touches anything; ends: `ends_code` of the events that end an episode. Contact with
    a wall counts as "off_track", or as "collision" if "off_track" does not end an episode.
    """
    # Walls stand 2.5 m beyond the edge, so the car is off the track before it touches one. The
    # contact counts even if the car is back on the road by the end of the same control step.
    if (off_track or wall) and ends & 1:
        return 1
    if backwards and ends & 2:
        return 2
    return 3 if touched and ends & 4 else 0


def ends_code(ends: Collection[Ending]) -> int:
    """Return a bit mask of the events `ends`: bit k stands for ENDINGS[k]."""
    return sum(1 << k for k, event in enumerate(ENDINGS) if event in ends)


ALL_ENDS = ends_code(ENDINGS)


def ending(state: CarState, ends: Collection[Ending] = ENDINGS) -> Ending | None:
    """Return the event of `ends` that ends an episode at `state`; None if the episode continues."""
    touched, bits = state.collision, ALL_ENDS if ends is ENDINGS else ends_code(ends)
    code = ending_code(
        state.off_track, state.backwards, touched == "wall", touched is not None, bits
    )
    return ENDINGS[code - 1] if code else None


@compiled
def step_reward(
    angle: float,
    to_middle: float,
    half_width: float,
    ended: bool,
    weight: float = 1.0,
) -> float:
    """Return cos(angle) - weight |sin(angle)| - |to_middle| / half_width. If the episode ends
    (`ended`) or the car points backwards (|angle| >= pi/2), return -2.

    angle in rad; to_middle and half_width (half of the track's own width) in m; weight is the
    paper's lambda. A score is the sum over a fixed number of steps.
    """
    if ended or abs(angle) >= 0.5 * math.pi:
        return OFF_TRACK_REWARD
    return math.cos(angle) - weight * abs(math.sin(angle)) - abs(to_middle) / half_width


@callable_from_compiled
def quadratic_reward(offset: float, angle: float, steer: float, ended: bool) -> float:
    """Return -(0.3 offset^2 + angle^2 + 0.03 delta^2), or -2 if the episode ends (`ended`).

    offset in m from the line to follow; angle in rad; delta is the angle of the front wheels in rad
    for the steering action `steer` in [-1, 1].
    """
    if ended:
        return OFF_TRACK_REWARD
    delta = steer * STEERING_LOCK
    return -(0.3 * offset * offset + angle * angle + 0.03 * delta * delta)


@dataclass(frozen=True)
class EpisodeOptions:
    """Reward and termination of the episodes. Raises UserError for a bad option."""

    reward: Reward | None = None
    """A function `reward(state, road, ending) -> float`; None uses `step_reward`."""

    lambda_: float = 1.0
    """Weight of |sin(angle)| in `step_reward`."""

    ends: Collection[Ending] = ENDINGS
    """Events that end an episode; after other events it continues."""

    def __post_init__(self) -> None:
        if self.reward is not None and not callable(self.reward):
            raise UserError(
                f"reward is {self.reward!r}; give a function of (state, road, ending), or None "
                "for the default reward"
            )
        number = isinstance(self.lambda_, int | float | np.number)
        if not (number and math.isfinite(self.lambda_)):
            raise UserError(f"lambda_ is {self.lambda_!r}; give a finite weight")
        if self.reward is not None and self.lambda_ != 1.0:
            raise UserError(
                "lambda_ is a weight of the default reward; leave it out if `reward` is given"
            )
        listed = isinstance(self.ends, Collection) and not isinstance(self.ends, str)
        if not listed or any(event not in ENDINGS for event in self.ends):
            raise UserError(
                f"ends is {self.ends!r}; give a list of the events that end an episode, out of "
                f"{', '.join(ENDINGS)}"
            )

    def compute_reward(self, state: CarState, road: Road, ended: Ending | None) -> float:
        """Return the number that the user's function `reward`, which must not be None, gives for a
        step that led to `state` and to the event `ended`, or None. Raises UserError unless the
        number is finite."""
        assert self.reward is not None
        reward = float(self.reward(state, road, ended))
        if not math.isfinite(reward):
            raise UserError(
                f"your reward function returned {reward} at {state}; return a finite number"
            )
        return reward
