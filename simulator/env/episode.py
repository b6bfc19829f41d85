"""The rules of an episode: what it pays and what ends it."""

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass

from simulator.env.reward import ENDINGS, Ending, ending, step_reward
from simulator.track.road import Road
from simulator.vehicle.state import CarState
from trackfeatures.errors import UserError

Reward = Callable[[CarState, Road, Ending | None], float]
"""Of the state that a step led to, on its road, and why the episode ends there, if it does."""


@dataclass(frozen=True)
class EpisodeOptions:
    """Reward and ending of an environment's episodes."""

    reward: Reward | None = None
    """`reward(state, road, ending) -> float`; None is the paper's."""

    lambda_: float = 1.0
    """Weight of |sin(angle)| in the paper's reward."""

    ends: Collection[Ending] = ENDINGS
    """What ends an episode; what is left out is driven on through."""

    def __post_init__(self) -> None:
        if self.reward is not None and not callable(self.reward):
            raise UserError(
                f"reward is {self.reward!r}; give a function of (state, road, ending), or None "
                "for the paper's"
            )
        if not math.isfinite(self.lambda_):
            raise UserError(f"lambda_ is {self.lambda_}; give a finite weight")
        if self.reward is not None and self.lambda_ != 1.0:
            raise UserError("lambda_ weighs the paper's reward only; leave it out beside `reward`")
        unknown = [self.ends] if isinstance(self.ends, str) else set(self.ends) - set(ENDINGS)
        if unknown:
            raise UserError(
                f"ends is {self.ends!r}; give a list of what ends an episode, out of "
                f"{', '.join(ENDINGS)}"
            )

    def ending(self, state: CarState) -> Ending | None:
        """Why the episode ends at `state`, None while it goes on."""
        return ending(state, self.ends)

    def pay(self, state: CarState, road: Road, ended: Ending | None) -> float:
        """The reward of a step that led to `state`. Raises UserError for one that is no number."""
        if self.reward is None:
            return step_reward(
                state.angle, state.to_middle, road.half_width, ended is not None, self.lambda_
            )
        paid = float(self.reward(state, road, ended))
        if not math.isfinite(paid):
            raise UserError(f"your reward function returned {paid} at {state}; return a number")
        return paid
