"""DDPG and TD3 with many cars. The agent and its updates are the same as with one car, except for
larger mini-batches."""

from dataclasses import replace

import numpy as np

from controllers.laws.actor_state import StateDefinition
from controllers.rl.agent import Agent
from controllers.rl.cars import Array, Step
from controllers.rl.checkpoint import Tensors
from controllers.rl.config import EXPLORATION_NOISE, Algorithm, exploration_share

BATCH = 256
"""Number of transitions per update. The computing time per transition is half of the time per
transition with 64 transitions per update."""
STEPS_PER_UPDATE = 8
"""Control steps per update, summed over all cars."""


class OffPolicy:
    """DDPG or TD3 with N cars. In each control step `explore` is called once, then `learn`."""

    horizon = 1

    def __init__(self, algorithm: Algorithm, definition: StateDefinition, seed: int) -> None:
        self._agent = Agent(replace(algorithm, batch=BATCH), definition, seed)
        self.divisor, self.odd = self._agent.divisor, algorithm.mirrored

    def act(self, states: Array) -> Array:
        """Return the actions (N,) of the target actor, whose weights `weights` returns, for states
        (N, size)."""
        return self._agent.act_all(self._agent.see(states), target=True)

    def explore(self, states: Array, rng: np.random.Generator) -> Array:
        """Return the present actor's actions (N,) for states (N, size). Random noise is added with
        a probability that falls during the training."""
        agent, count = self._agent, len(states)
        noise = agent.algorithm.beta * EXPLORATION_NOISE * rng.standard_normal(count, np.float32)
        noise *= rng.random(count) < exploration_share(agent.replay.added)
        return np.clip(agent.act_all(agent.see(states)) + noise, -1.0, 1.0)

    def learn(
        self, states: Array, actions: Array, step: Step, rng: np.random.Generator, left: float
    ) -> dict[str, float]:
        """Add the transitions of a step to the replay and update the networks; return the means of
        the critics' loss and of the reward by name, {} in a step without an update.

        `left`: share of the training that remains, from 1 down to 0.
        """
        agent, of = self._agent, self._agent.algorithm
        before = agent.replay.added // STEPS_PER_UPDATE
        rows = zip(
            *(agent.see(states), actions.tolist(), step.rewards.tolist()),
            *(agent.see(step.last), step.ended.tolist()),
            strict=True,
        )
        for row in rows:
            agent.remember(*row)
        updates = agent.replay.added // STEPS_PER_UPDATE - before
        if len(agent.replay) < of.learning_starts or not updates:
            return {}
        share = of.rate_end + (1.0 - of.rate_end) * left
        losses = [agent.update(rng, share) for _ in range(updates)]
        return {"loss": float(np.mean(losses)), "reward": float(step.rewards.mean())}

    def weights(self) -> dict[str, Array]:
        """Return the arrays of an actor's file (w1, b1, w2, b2, w3, b3) for the target actor."""
        return self._agent.weights()

    def store(self) -> tuple[Tensors, dict[str, int]]:
        """Return the arrays (networks, moments, replay) and the counts (updates, transitions added)
        that a continued training needs, by name."""
        return self._agent.store()

    def restore(self, tensors: Tensors, counts: dict[str, int]) -> None:
        """Restore the arrays and counts that `store` returned."""
        self._agent.restore(tensors, counts)
