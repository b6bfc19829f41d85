"""One update of DDPG or TD3 on a mini-batch, in place.

DDPG: Lillicrap et al. 2016 (the paper's equations of the critic's loss, its target and the actor's
gradient). TD3 (Fujimoto et al. 2018) is the same with the smaller of two critics' targets, noise on
the target's action, and an actor updated every second time.
"""

from dataclasses import dataclass

import numpy as np

from controllers.rl.networks import Array, Shape, backward, forward, initial, layers

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8  # Adam's usual ones


@dataclass(frozen=True)
class Batch:
    """B transitions. An ended one is followed by no more reward."""

    states: Array  # (B, state)
    actions: Array  # (B,)
    rewards: Array  # (B,)
    next_states: Array  # (B, state)
    ended: Array  # (B,), 1.0 or 0.0


class Trained:
    """N networks of one shape, their target networks, and Adam's moments."""

    def __init__(self, shape: Shape, count: int, rng: np.random.Generator) -> None:
        self.theta = initial(shape, count, rng)
        self.target = self.theta.copy()
        self.moments = np.zeros((2, *self.theta.shape), np.float32)
        self.layers = layers(self.theta, shape)
        self.target_layers = layers(self.target, shape)
        self._gradient = np.zeros_like(self.theta)
        self.gradient = layers(self._gradient, shape)

    def descend(self, rate: float, number: int) -> None:
        """Adam's step `number` (from 1) along `gradient` with the learning rate `rate`."""
        first, second = self.moments
        first += (1.0 - BETA_1) * (self._gradient - first)
        second += (1.0 - BETA_2) * (self._gradient * self._gradient - second)
        size = np.sqrt(second / (1.0 - BETA_2**number))
        size += EPSILON
        self.theta -= (rate / (1.0 - BETA_1**number)) * first / size

    def soft_update(self, tau: float) -> None:
        """target <- tau theta + (1 - tau) target."""
        self.target += tau * (self.theta - self.target)


def critic_update(
    actor: Trained, critics: Trained, batch: Batch, noise: Array, discount: float
) -> float:
    """Fill the critics' gradient towards r + discount min Q'(s', mu'(s') + noise); returns their
    mean squared error."""
    following = np.tanh(forward(actor.target_layers, batch.next_states).out[0])
    following = np.clip(following + noise, -1.0, 1.0)
    values = forward(critics.target_layers, batch.next_states, following).out.min(axis=0)
    wanted = batch.rewards + discount * (1.0 - batch.ended) * values
    seen = forward(critics.layers, batch.states, batch.actions)
    error = seen.out - wanted
    slope = np.asarray((2.0 / len(wanted)) * error, np.float32)
    backward(critics.layers, seen, slope, critics.gradient)
    return float(np.mean(error * error))


def actor_update(actor: Trained, critics: Trained, shape: Shape, states: Array) -> None:
    """Fill the actor's gradient, down which the first critic's Q(s, mu(s)) grows."""
    seen = forward(actor.layers, states)
    actions = np.tanh(seen.out)
    first = layers(critics.theta[:1], shape)
    judged = forward(first, states, actions[0])
    descent = np.full_like(actions, -1.0 / len(states))
    slope = backward(first, judged, descent, None)[:, :, -1]
    slope *= 1.0 - actions * actions
    backward(actor.layers, seen, slope, actor.gradient)
