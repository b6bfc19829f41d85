"""One update of DDPG or TD3 on a mini-batch, in place, as compiled code.

DDPG: Lillicrap et al. 2016 (the paper's equations of the critic's loss, its target and the actor's
gradient). TD3 (Fujimoto et al. 2018) is the same with the smaller of two critics' targets, noise on
the target's action, and an actor updated every second time.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.rl.networks import Matrix, Shape, Vector, backward, forward
from runtime.jit import compiled

Moments = NDArray[np.float32]
BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8  # Adam's usual ones


class Batch(NamedTuple):
    """B transitions. An ended one is followed by no more reward."""

    states: Matrix  # (B, state)
    actions: Vector  # (B,)
    rewards: Vector  # (B,)
    next_states: Matrix  # (B, state)
    ended: Vector  # (B,), 1.0 or 0.0


class Learner(NamedTuple):
    """The parameters of an actor and its critics, their targets, and Adam's moments."""

    actor: Vector  # (A,)
    actor_target: Vector  # (A,)
    actor_moments: Matrix  # (2, A)
    critics: Matrix  # (critics, C)
    critic_targets: Matrix  # (critics, C)
    critic_moments: Moments  # (critics, 2, C)


@compiled
def adam(
    theta: Vector, gradient: Vector, moments: Matrix, rate: float, number: int
) -> None:
    """Adam's step `number` (from 1) with the learning rate `rate`."""
    one = np.float32(1.0)
    beta_1, beta_2, epsilon = np.float32(BETA_1), np.float32(BETA_2), np.float32(EPSILON)
    step = np.float32(rate / (1.0 - BETA_1**number))
    correction = np.float32(1.0 / (1.0 - BETA_2**number))
    first, second = moments[0], moments[1]
    for i in range(theta.shape[0]):
        g = gradient[i]
        first[i] = beta_1 * first[i] + (one - beta_1) * g
        second[i] = beta_2 * second[i] + (one - beta_2) * g * g
        theta[i] -= step * first[i] / (np.sqrt(second[i] * correction) + epsilon)


@compiled
def soft_update(target: Vector, source: Vector, tau: float) -> None:
    """target <- tau source + (1 - tau) target."""
    share = np.float32(tau)
    for i in range(target.shape[0]):
        target[i] += share * (source[i] - target[i])


@compiled
def act(theta: Vector, shape: Shape, states: Matrix, z: Matrix, h2: Matrix) -> Vector:
    """The actor's actions (B,) in [-1, 1]."""
    out = np.empty(states.shape[0], np.float32)
    forward(theta, shape, states, out, z, h2, out)
    return np.tanh(out)


@compiled
def critic_update(
    learner: Learner,
    shape: Shape,
    batch: Batch,
    noise: Vector,
    discount: float,
    rate: float,
    number: int,
) -> float:
    """Move each critic towards r + discount Q'(s', mu'(s') + noise); returns the mean loss."""
    count = batch.states.shape[0]
    z = np.empty((count, shape[1] + 1), np.float32)
    h2 = np.empty((count, shape[2]), np.float32)
    q = np.empty(count, np.float32)
    critic_shape = (shape[0], shape[1], shape[2], 1)
    following = act(learner.actor_target, shape, batch.next_states, z[:, : shape[1]].copy(), h2)
    for row in range(count):
        wanted = following[row] + noise[row]
        following[row] = min(max(wanted, np.float32(-1.0)), np.float32(1.0))
    wanted_q = np.full(count, np.float32(np.inf))
    for k in range(learner.critics.shape[0]):
        forward(learner.critic_targets[k], critic_shape, batch.next_states, following, z, h2, q)
        wanted_q = np.minimum(wanted_q, q)
    wanted_q = (
        batch.rewards + np.float32(discount) * (np.float32(1.0) - batch.ended) * wanted_q
    )
    gradient = np.empty(learner.critics.shape[1], np.float32)
    unused = np.empty(count, np.float32)
    loss = 0.0
    for k in range(learner.critics.shape[0]):
        theta = learner.critics[k]
        forward(theta, critic_shape, batch.states, batch.actions, z, h2, q)
        error = q - wanted_q
        loss += float(np.mean(error * error)) / learner.critics.shape[0]
        g_out = error * np.float32(2.0 / count)
        backward(theta, critic_shape, batch.states, z, h2, g_out, gradient, unused)
        adam(theta, gradient, learner.critic_moments[k], rate, number)
    return loss


@compiled
def actor_update(learner: Learner, shape: Shape, states: Matrix, rate: float, number: int) -> None:
    """Move the actor along the gradient of the first critic's Q(s, mu(s))."""
    count = states.shape[0]
    critic_shape = (shape[0], shape[1], shape[2], 1)
    z = np.empty((count, shape[1]), np.float32)
    h2 = np.empty((count, shape[2]), np.float32)
    actions = act(learner.actor, shape, states, z, h2)
    critic_z = np.empty((count, shape[1] + 1), np.float32)
    critic_h2 = np.empty((count, shape[2]), np.float32)
    q = np.empty(count, np.float32)
    slope = np.empty(count, np.float32)
    critic = learner.critics[0]
    forward(critic, critic_shape, states, actions, critic_z, critic_h2, q)
    descent = np.full(count, np.float32(-1.0 / count))
    unused = np.empty(critic.shape[0], np.float32)
    backward(critic, critic_shape, states, critic_z, critic_h2, descent, unused, slope)
    g_out = slope * (np.float32(1.0) - actions * actions)
    gradient = np.empty(learner.actor.shape[0], np.float32)
    backward(learner.actor, shape, states, z, h2, g_out, gradient, q)
    adam(learner.actor, gradient, learner.actor_moments, rate, number)
