"""The agent of DDPG and TD3: actor, critics, replay of transitions, and updates."""

import numpy as np
from numpy.typing import NDArray

from controllers.laws.actor import mirror_of
from controllers.laws.actor_state import StateDefinition
from controllers.rl.checkpoint import Tensors
from controllers.rl.config import Algorithm
from controllers.rl.ddpg_td3_updates import Batch, Trained, actor_update, critic_update
from controllers.rl.networks import Array, Shape, forward, layers

TARGET_NOISE_CUT = 2.5  # standard deviations; TD3 clips noise of 0.2 at 0.5


class Replay:
    """Stores the last `capacity` transitions; a state has `size` numbers."""

    def __init__(self, capacity: int, size: int) -> None:
        self.states = np.zeros((capacity, size), np.float32)
        self.next_states = np.zeros((capacity, size), np.float32)
        self.results = np.zeros((capacity, 3), np.float32)
        """Action, reward, and 1 if the episode ended, otherwise 0."""
        self.added = 0
        """Number of transitions added so far, including overwritten transitions."""

    def __len__(self) -> int:
        return min(self.added, len(self.states))

    def add(
        self, state: Array, action: float, reward: float, next_state: Array, ended: bool
    ) -> None:
        """Store the transition from `state` (size,) to `next_state` (size,). When the replay is
        full, it overwrites the oldest transition."""
        place = self.added % len(self.states)
        self.states[place], self.next_states[place] = state, next_state
        self.results[place] = action, reward, ended
        self.added += 1

    def sample(self, places: NDArray[np.int64]) -> Batch:
        """Return copies of the transitions with the indices `places` (B,)."""
        results = self.results[places]
        return Batch(
            self.states[places],
            results[:, 0].copy(),
            results[:, 1].copy(),
            self.next_states[places],
            results[:, 2].copy(),
        )


class Agent:
    """An actor and its critics; `update` is called once for each control step."""

    def __init__(
        self,
        algorithm: Algorithm,
        definition: StateDefinition,
        seed: int,
    ) -> None:
        rng = np.random.default_rng([seed, 0])
        self.algorithm = algorithm
        self.shape = Shape(definition.size, *algorithm.hidden)
        self._critic_shape = Shape(definition.size, *algorithm.hidden, 1)
        self.actor = Trained(self.shape, 1, rng)
        self.critics = Trained(self._critic_shape, algorithm.critics, rng)
        self.replay = Replay(algorithm.replay, definition.size)
        self.updates = 0
        spread = np.array(definition.spread, np.float32)
        self.divisor = spread if algorithm.scaled else np.ones_like(spread)
        self._order, self._signs = mirror_of(definition)

    def see(self, state: Array) -> Array:
        """Return the input of the networks for states (..., size). If the algorithm is `scaled`,
        each number of a state is divided by its typical size."""
        return np.asarray(state / self.divisor, np.float32)

    def act(self, seen: Array) -> float:
        """Return the present actor's action in [-1, 1] for an input (size,) of the networks."""
        rows = seen[None]
        if self.algorithm.mirrored:
            rows = np.stack([seen, seen[self._order] * self._signs])
        actions = np.tanh(forward(self.actor.layers, rows).out[0])
        return float(0.5 * (actions[0] - actions[1]) if len(rows) == 2 else actions[0])

    def remember(
        self, seen: Array, action: float, reward: float, next_seen: Array, ended: bool
    ) -> None:
        """Add the transition from `seen` (size,) to `next_seen` (size,) to the replay; both are
        inputs of the networks.

        The algorithm's `reward_baseline` is subtracted from the reward. If the episode `ended`, the
        stored reward also contains the discounted sum of the following steps: after a terminal
        state all steps have the reward 0, from which the baseline is subtracted, too.
        """
        of = self.algorithm
        value = reward - of.reward_baseline
        if ended:
            value -= of.reward_baseline * of.discount / (1.0 - of.discount)
        self.replay.add(seen, action, of.reward_scale * value, next_seen, ended)

    def act_all(self, seen: Array, *, target: bool = False) -> Array:
        """Return the actions (N,) of the present actor, or with `target` of the target actor, for
        inputs (N, size) of the networks."""
        rows = seen
        if self.algorithm.mirrored:
            rows = np.concatenate((seen, seen[:, self._order] * self._signs))
        of = layers(self.actor.target, self.shape) if target else self.actor.layers
        actions: Array = np.tanh(forward(of, rows).out[0])
        return (
            0.5 * (actions[: len(seen)] - actions[len(seen) :])
            if len(rows) > len(seen)
            else actions
        )

    def weights(self) -> dict[str, Array]:
        """Return the arrays of an actor's file (w1, b1, w2, b2, w3, b3) for the target actor.

        The target actor is an average of the actor over the last updates. It steers more smoothly
        than the actor itself.
        """
        of = layers(self.actor.target.copy(), self.shape)
        flat = {name: array[0] for name, array in of._asdict().items()}
        return flat | {name: flat[name].reshape(-1) for name in ("b1", "b2", "w3", "b3")}

    def store(self) -> tuple[Tensors, dict[str, int]]:
        """Return the arrays (networks, moments, replay) and the counts (updates, transitions added)
        that a continued training needs, by name."""
        filled = {name: array[: len(self.replay)] for name, array in self._replayed().items()}
        counts = {"updates": self.updates, "added": self.replay.added}
        return self._parameters() | filled, counts

    def restore(self, tensors: Tensors, counts: dict[str, int]) -> None:
        """Restore the arrays and counts that `store` returned."""
        for name, array in self._parameters().items():
            array[:] = tensors[name]
        for name, array in self._replayed().items():
            array[: len(tensors[name])] = tensors[name]
        self.updates, self.replay.added = counts["updates"], counts["added"]

    def _parameters(self) -> Tensors:
        """Return parameters and Adam's moments by name; they are not copied."""
        return {
            f"{name}.{part}": getattr(networks, part)
            for name, networks in (("actor", self.actor), ("critics", self.critics))
            for part in ("theta", "target", "moments")
        }

    def _replayed(self) -> Tensors:
        names = ("states", "next_states", "results")
        return {f"replay.{name}": getattr(self.replay, name) for name in names}

    def update(self, rng: np.random.Generator, rate_share: float) -> float:
        """Update the networks with a random mini-batch; returns the critics' loss.

        `rate_share` is a factor on the learning rates.
        """
        of = self.algorithm
        batch = self.replay.sample(rng.integers(len(self.replay), size=of.batch))
        if of.mirrored:
            self._mirror(batch, rng.random(of.batch) < 0.5)
        self.updates += 1
        noise = self._target_noise(rng)
        loss = critic_update(self.actor, self.critics, batch, noise, of.discount)
        self.critics.descend(of.critic_rate * rate_share, self.updates)
        if self.updates % of.actor_delay == 0:
            actor_update(self.actor, self.critics, self._critic_shape, batch.states)
            self.actor.descend(of.actor_rate * rate_share, self.updates // of.actor_delay)
            self.actor.soft_update(of.tau)
            self.critics.soft_update(of.tau)
        return loss

    def _target_noise(self, rng: np.random.Generator) -> Array:
        of = self.algorithm
        if not of.target_noise:
            return np.zeros(of.batch, np.float32)
        cut = TARGET_NOISE_CUT * of.target_noise
        drawn = of.target_noise * rng.standard_normal(of.batch, np.float32)
        return np.asarray(np.clip(drawn, -cut, cut), np.float32)

    def _mirror(self, batch: Batch, chosen: NDArray[np.bool_]) -> None:
        """Exchange left and right in the `chosen` rows (B,) of `batch`."""
        for states in (batch.states, batch.next_states):
            states[chosen] = states[chosen][:, self._order] * self._signs
        batch.actions[chosen] *= -1.0
