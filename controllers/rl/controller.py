"""A trained actor as a controller. One `update` is three small matrix products in numpy."""

import math
from dataclasses import replace
from pathlib import Path

from controllers.interface import LoopConfig, Observation
from controllers.rl.actor import Actor, load_actor
from controllers.rl.state import EXACT, STEP_S, StateBuilder, paper_state
from trackfeatures.errors import UserError

FARTHEST_M = 1.0
"""Limit of the offset on perception: from further away an actor returns at an angle of 0.3 rad, and
the model that ships answers 0.25 rad at most."""
SHIPPED = Path(__file__).parent.parent / "weights"


class RlController:
    """Steers as `actor` answers, without noise."""

    def __init__(self, actor: Actor, loop: LoopConfig = EXACT) -> None:
        self._actor = actor
        self._states = StateBuilder(actor.definition, loop)
        self._farthest_m = FARTHEST_M if loop.noisy else math.inf

    def update(self, observation: Observation) -> float:
        if abs(observation.to_lane_centre) > self._farthest_m:
            offset = math.copysign(self._farthest_m, observation.to_lane_centre)
            observation = replace(observation, to_lane_centre=offset)
        paper = paper_state(observation, self._actor.card.half_width_m)
        return self._states.steer(self._actor.steer(self._states.build(paper, observation)))


def load_controller(folder: Path, loop: LoopConfig = EXACT) -> RlController:
    """The controller of an actor's folder. Raises ActorError for unusable files, UserError for
    another rate than that of the training."""
    if loop.dt != STEP_S:
        raise UserError(f"{folder.name} was trained for steps of {STEP_S:g} s, not {loop.dt:g}")
    return RlController(load_actor(folder), loop)


def make_rl(loop: LoopConfig) -> RlController:
    """The actor of the paper's state that ships with the project; UserError for another rate."""
    return load_controller(SHIPPED / "rl", loop)


def make_rl_residual(loop: LoopConfig) -> RlController:
    """The actor that ships with the project and adds to LQR; UserError for another rate."""
    return load_controller(SHIPPED / "rl-residual", loop)
