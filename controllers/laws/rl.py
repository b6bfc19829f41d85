"""A controller that steers by a trained actor. An `update` computes three small matrix products."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from controllers.interface import LoopConfig, Observation, Observations
from controllers.laws.actor import SHIPPED, Actor, load_actor
from controllers.laws.actor_state import EXACT, STEP_S, StateBuilder, paper_state
from trackfeatures.errors import UserError

FARTHEST_M = 0.8
"""Largest offset (m) that an actor receives on perception. At an offset of 1 m the shipped actor
turns the car by 0.28 rad towards the lane, but in drives the model `default` answered no angle
above 0.25 rad."""


class RlController:
    """Steers by the actions of `actor`. No noise is added to the actions."""

    def __init__(self, actor: Actor, loop: LoopConfig = EXACT) -> None:
        self._actor, self._loop = actor, loop
        self._cars: list[RlController] = []
        """One controller for each car that `update_batch` steers."""
        self._states = StateBuilder(actor.definition, loop)
        self._farthest_m = FARTHEST_M if loop.noisy else math.inf

    def update(self, observation: Observation) -> float:
        if abs(observation.to_lane_centre) > self._farthest_m:
            offset = math.copysign(self._farthest_m, observation.to_lane_centre)
            observation = replace(observation, to_lane_centre=offset)
        paper = paper_state(observation, self._actor.card.half_width_m)
        return self._states.steer(self._actor.steer(self._states.build(paper, observation)))

    def update_batch(self, observations: Observations) -> NDArray[np.float64]:
        # The cars are computed one by one, because the rounding of a matrix product depends on the
        # number of its rows.
        if len(self._cars) != len(observations):
            self._cars = [RlController(self._actor, self._loop) for _ in range(len(observations))]
        pairs = zip(self._cars, observations.split(), strict=True)
        return np.array([car.update(observation) for car, observation in pairs])


def load_controller(folder: Path, loop: LoopConfig = EXACT) -> RlController:
    """Load the actor in `folder` as a controller.

    Raises ActorError for unusable files and UserError for a control step other than the control
    step of the training.
    """
    if loop.dt != STEP_S:
        raise UserError(f"{folder.name} was trained for steps of {STEP_S:g} s, not {loop.dt:g}")
    return RlController(load_actor(folder), loop)


def make_rl(loop: LoopConfig) -> RlController:
    """Load the shipped actor of the paper's state. Raises UserError unless `loop.dt` is 0.05 s."""
    return load_controller(SHIPPED / "rl", loop)


def make_rl_residual(loop: LoopConfig) -> RlController:
    """Load the shipped actor that corrects LQR. Raises UserError unless `loop.dt` is 0.05 s."""
    return load_controller(SHIPPED / "rl-residual", loop)
