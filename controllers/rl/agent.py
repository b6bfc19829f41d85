"""The learning agent: its actor and critics, its replay of transitions, and its updates."""

import numpy as np
from numpy.typing import NDArray

from controllers.rl.actor import mirror_of
from controllers.rl.config import Algorithm
from controllers.rl.networks import Shape, Vector, initial, parameter_count
from controllers.rl.state import StateDefinition
from controllers.rl.updates import (
    Batch,
    Learner,
    act,
    actor_update,
    critic_update,
    soft_update,
)

TARGET_NOISE_CUT = 2.5  # standard deviations, as TD3's 0.5 of 0.2
FIRST_WEIGHTS = 1
"""Marks the random numbers of the first weights; an episode's are marked by its number."""


class Replay:
    """The last `capacity` transitions."""

    def __init__(self, capacity: int, size: int) -> None:
        self.states = np.zeros((capacity, size), np.float32)
        self.next_states = np.zeros((capacity, size), np.float32)
        self.results = np.zeros((capacity, 3), np.float32)
        """Action, reward, and 1 where the episode ended."""
        self.added = 0

    def __len__(self) -> int:
        return min(self.added, len(self.states))

    def add(
        self, state: Vector, action: float, reward: float, following: Vector, ended: bool
    ) -> None:
        place = self.added % len(self.states)
        self.states[place], self.next_states[place] = state, following
        self.results[place] = action, reward, ended
        self.added += 1

    def sample(self, places: NDArray[np.int64]) -> Batch:
        """The transitions at `places` (B,), copied."""
        results = self.results[places]
        return Batch(
            self.states[places],
            results[:, 0].copy(),
            results[:, 1].copy(),
            self.next_states[places],
            results[:, 2].copy(),
        )


class Agent:
    """`steps` counts the updates asked for; the first ones only fill the replay."""

    def __init__(
        self, algorithm: Algorithm, definition: StateDefinition, rates: tuple[float, float], seed: int
    ) -> None:
        rng = np.random.default_rng([seed, 0, FIRST_WEIGHTS])
        self.algorithm = algorithm
        self._rates = rates
        self.shape: Shape = (definition.size, *algorithm.hidden, 0)
        critic_shape: Shape = (definition.size, *algorithm.hidden, 1)
        actor = initial(self.shape, rng)
        critics = np.stack([initial(critic_shape, rng) for _ in range(algorithm.critics)])
        self.learner = Learner(
            actor=actor,
            actor_target=actor.copy(),
            actor_moments=np.zeros((2, len(actor)), np.float32),
            critics=critics,
            critic_targets=critics.copy(),
            critic_moments=np.zeros((len(critics), 2, parameter_count(critic_shape)), np.float32),
        )
        self.replay = Replay(algorithm.replay, definition.size)
        self.updates = 0
        spread = np.array(definition.spread, np.float32)
        self._divisor = spread if algorithm.scaled else np.ones_like(spread)
        self._order, self._signs = mirror_of(definition)
        rows = 2 if algorithm.mirrored else 1
        self._z = np.empty((rows, self.shape[1]), np.float32)
        self._h2 = np.empty((rows, self.shape[2]), np.float32)

    def see(self, state: Vector) -> Vector:
        """The networks' input for a state (size,)."""
        return state / self._divisor

    def act(self, seen: Vector) -> float:
        """The present actor's action for a network's input."""
        rows = seen[None]
        if self.algorithm.mirrored:
            rows = np.stack([seen, seen[self._order] * self._signs])
        actions = act(self.learner.actor, self.shape, rows, self._z, self._h2)
        return float(0.5 * (actions[0] - actions[1]) if len(rows) == 2 else actions[0])

    def remember(
        self, seen: Vector, action: float, reward: float, following: Vector, ended: bool
    ) -> None:
        """Keep a transition. With a baseline, an end stands for the same rewards ever after."""
        of = self.algorithm
        value = reward - of.reward_baseline
        if ended:
            value -= of.reward_baseline * of.discount / (1.0 - of.discount)
        self.replay.add(seen, action, of.reward_scale * value, following, ended)

    def update(self, rng: np.random.Generator, rate_share: float) -> float:
        """One update on a random mini-batch; returns the critics' loss."""
        of, learner = self.algorithm, self.learner
        batch = self.replay.sample(rng.integers(len(self.replay), size=of.batch))
        if of.mirrored:
            batch = self._mirror(batch, rng.random(of.batch) < 0.5)
        noise = np.zeros(of.batch, np.float32)
        if of.target_noise:
            cut = TARGET_NOISE_CUT * of.target_noise
            drawn = of.target_noise * rng.standard_normal(of.batch, np.float32)
            noise = np.clip(drawn, -cut, cut).astype(np.float32)
        self.updates += 1
        actor_rate, critic_rate = (rate * rate_share for rate in self._rates)
        loss: float = critic_update(
            learner, self.shape, batch, noise, of.discount, critic_rate, self.updates
        )
        if self.updates % of.actor_delay == 0:
            number = self.updates // of.actor_delay
            actor_update(learner, self.shape, batch.states, actor_rate, number)
            soft_update(learner.actor_target, learner.actor, of.tau)
            for target, critic in zip(learner.critic_targets, learner.critics, strict=True):
                soft_update(target, critic, of.tau)
        return loss

    def _mirror(self, batch: Batch, chosen: NDArray[np.bool_]) -> Batch:
        """`batch` with left and right exchanged in the chosen rows."""
        for states in (batch.states, batch.next_states):
            states[chosen] = states[chosen][:, self._order] * self._signs
        batch.actions[chosen] *= -1.0
        return batch
