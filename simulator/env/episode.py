"""The options of an episode: its reward and its termination."""

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass

from simulator.env.reward import ENDINGS, Ending, ending, step_reward
from simulator.track.road import Road
from simulator.vehicle.state import CarState
from trackfeatures.errors import UserError

Reward = Callable[[CarState, Road, Ending | None], float]
"""Reward function of (state after the step, road, why the episode ends or None)."""


@dataclass(frozen=True)
class EpisodeOptions:
    """Reward and termination of an environment's episodes. Raises UserError for a bad option."""

    reward: Reward | None = None
    """`reward(state, road, ending) -> float`; None is `reward.step_reward`."""

    lambda_: float = 1.0
    """Weight of |sin(angle)| in `reward.step_reward`."""

    ends: Collection[Ending] = ENDINGS
    """The events that end an episode; after others it goes on."""

    def __post_init__(self) -> None:
        if self.reward is not None and not callable(self.reward):
            raise UserError(
                f"reward is {self.reward!r}; give a function of (state, road, ending), or None "
                "for the default reward"
            )
        if not math.isfinite(self.lambda_):
            raise UserError(f"lambda_ is {self.lambda_}; give a finite weight")
        if self.reward is not None and self.lambda_ != 1.0:
            raise UserError(
                "lambda_ is a weight of the default reward; leave it out if `reward` is given"
            )
        unknown = [self.ends] if isinstance(self.ends, str) else set(self.ends) - set(ENDINGS)
        if unknown:
            raise UserError(
                f"ends is {self.ends!r}; give a list of the events that end an episode, out of "
                f"{', '.join(ENDINGS)}"
            )

    def ending(self, state: CarState) -> Ending | None:
        """The reason why the episode ends at `state`, None if it goes on."""
        return ending(state, self.ends)

    def compute_reward(self, state: CarState, road: Road, ended: Ending | None) -> float:
        """The reward of a step that led to `state`. Raises UserError if it is not finite."""
        if self.reward is None:
            return step_reward(
                state.angle, state.to_middle, road.half_width, ended is not None, self.lambda_
            )
        reward = float(self.reward(state, road, ended))
        if not math.isfinite(reward):
            raise UserError(
                f"your reward function returned {reward} at {state}; return a finite number"
            )
        return reward
