"""The gradients of one update of DDPG or TD3 on a mini-batch, and Adam's step.

DDPG is from Lillicrap et al. 2016 (the paper's equations of the critic's loss, its target and the
actor's gradient). TD3 (Fujimoto et al. 2018) adds the smaller value of two target critics, noise on
the target action, and an actor that is updated after every second update of the critics.
"""

from dataclasses import dataclass

import numpy as np

from controllers.rl.networks import Array, Shape, backward, forward, initial, layers

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8  # Adam's usual settings


@dataclass(frozen=True)
class Batch:
    """A mini-batch of B transitions. If a transition ended its episode, the value of its next state
    is 0."""

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
        """Change the parameters by Adam's step `number` (from 1) with the learning rate `rate`."""
        first, second = self.moments
        first += (1.0 - BETA_1) * (self._gradient - first)
        second += (1.0 - BETA_2) * (self._gradient * self._gradient - second)
        size = np.sqrt(second / (1.0 - BETA_2**number))
        size += EPSILON
        self.theta -= (rate / (1.0 - BETA_1**number)) * first / size

    def soft_update(self, tau: float) -> None:
        """Move the target networks: target <- tau theta + (1 - tau) target."""
        self.target += tau * (self.theta - self.target)


def critic_update(
    actor: Trained, critics: Trained, batch: Batch, noise: Array, discount: float
) -> float:
    """Fill the critics' gradients with the gradients of their mean squared error. Returns this
    error.

    The target is r + discount min Q'(s', mu'(s') + noise), or r if the transition ended its
    episode. `noise` is (B,).
    """
    next_action = np.tanh(forward(actor.target_layers, batch.next_states).out[0])
    next_action = np.clip(next_action + noise, -1.0, 1.0)
    next_q = forward(critics.target_layers, batch.next_states, next_action).out.min(axis=0)
    td_target = batch.rewards + discount * (1.0 - batch.ended) * next_q
    q = forward(critics.layers, batch.states, batch.actions)
    td_error = q.out - td_target
    gradient = np.asarray((2.0 / len(td_target)) * td_error, np.float32)
    backward(critics.layers, q, gradient, critics.gradient)
    return float(np.mean(td_error * td_error))


def actor_update(actor: Trained, critics: Trained, shape: Shape, states: Array) -> None:
    """Fill `actor.gradient` with the gradient of the loss -mean Q(s, mu(s)); Q is the first critic.

    `shape` is the shape of a critic, `states` is (B, state).
    """
    policy = forward(actor.layers, states)
    actions = np.tanh(policy.out)
    critic = layers(critics.theta[:1], shape)
    q = forward(critic, states, actions[0])
    gradient = np.full_like(actions, -1.0 / len(states))
    action_gradient = backward(critic, q, gradient, None)[:, :, -1]
    action_gradient *= 1.0 - actions * actions
    backward(actor.layers, policy, action_gradient, actor.gradient)
