"""The reward of a control step, what ends an episode, and the options of both.

`step_reward` is the formula of the paper's section on the RL control module, with one difference:
the paper divides the lateral offset by half the width of the lane, this code by half the width of
the track. `quadratic_reward` is the paper's second reward.
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
"""Reward function of (state after the step, road, why the episode ends or None)."""


@compiled
def ending_code(off_track: bool, backwards: bool, wall: bool, touched: bool, ends: int) -> int:
    """One more than the index into ENDINGS of the event that ends an episode; 0 if it continues.

    wall: the car touches a wall; touched: it touches anything; ends: `ends_code` of the events that
    end an episode. Contact with a wall counts as "off_track"; if that does not end an episode, as
    "collision".
    """
    # Walls stand 2.5 m beyond the edge, so the car is off the track before it touches one. The
    # contact counts even if the car is back on the road by the end of the same control step.
    if (off_track or wall) and ends & 1:
        return 1
    if backwards and ends & 2:
        return 2
    return 3 if touched and ends & 4 else 0


def ends_code(ends: Collection[Ending]) -> int:
    """A bit mask of the events `ends`: bit k stands for ENDINGS[k]."""
    return sum(1 << k for k, event in enumerate(ENDINGS) if event in ends)


ALL_ENDS = ends_code(ENDINGS)


def ending(state: CarState, ends: Collection[Ending] = ENDINGS) -> Ending | None:
    """The event out of `ends` that ends an episode at `state`; None if the episode continues."""
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
    """cos(angle) - weight |sin(angle)| - |to_middle| / half_width, or -2 when the episode ends or
    the car points backwards (|angle| >= pi/2).

    angle in rad, to_middle and half_width (half of the track's own width) in m; weight is the
    paper's lambda. A score is the sum over a fixed number of steps.
    """
    if ended or abs(angle) >= 0.5 * math.pi:
        return OFF_TRACK_REWARD
    return math.cos(angle) - weight * abs(math.sin(angle)) - abs(to_middle) / half_width


@callable_from_compiled
def quadratic_reward(offset: float, angle: float, steer: float, ended: bool) -> float:
    """-(0.3 offset^2 + angle^2 + 0.03 delta^2), or -2 when the episode ends.

    offset in m from the line to follow, angle in rad, delta the front wheels' angle in rad at the
    steering action `steer` in [-1, 1].
    """
    if ended:
        return OFF_TRACK_REWARD
    delta = steer * STEERING_LOCK
    return -(0.3 * offset * offset + angle * angle + 0.03 * delta * delta)


@dataclass(frozen=True)
class EpisodeOptions:
    """Reward and termination of an environment's episodes. Raises UserError for a bad option."""

    reward: Reward | None = None
    """`reward(state, road, ending) -> float`; None is `step_reward`."""

    lambda_: float = 1.0
    """Weight of |sin(angle)| in `step_reward`."""

    ends: Collection[Ending] = ENDINGS
    """The events that end an episode; after other events it continues."""

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
        """The `reward` of a step that led to `state`. Raises UserError if it is not finite."""
        assert self.reward is not None
        reward = float(self.reward(state, road, ended))
        if not math.isfinite(reward):
            raise UserError(
                f"your reward function returned {reward} at {state}; return a finite number"
            )
        return reward
