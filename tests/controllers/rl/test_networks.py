"""Networks and updates: shapes, the layer of the action, gradients and Adam equal to torch's."""

from typing import Any

import numpy as np
import pytest

from controllers.rl.ddpg_td3_updates import Batch, Trained, actor_update, critic_update
from controllers.rl.networks import Array, Shape, backward, forward, initial, layers

torch = pytest.importorskip("torch")
RNG = np.random.default_rng(5)
SHAPE = Shape(state=7, h1=6, h2=5, actions=1)


def random(*shape: int) -> Array:
    return RNG.normal(size=shape).astype(np.float32)


def torch_critic(of: list[Any], states: Any, actions: Any) -> Any:
    """The critic of one row of parameters, in torch."""
    w1, b1, w2, b2, w3, b3 = of
    hidden = torch.relu(states @ w1 + b1)
    hidden = torch.relu(torch.cat([hidden, actions[:, None]], 1) @ w2 + b2)
    return (hidden @ w3 + b3)[:, 0]


def torch_actor(of: list[Any], states: Any) -> Any:
    """The actor, in torch."""
    w1, b1, w2, b2, w3, b3 = of
    return torch.tanh(torch.relu(torch.relu(states @ w1 + b1) @ w2 + b2) @ w3 + b3)[:, 0]


def as_torch(theta: Array, shape: Shape, row: int = 0) -> list[Any]:
    return [torch.tensor(a[row], requires_grad=True) for a in layers(theta, shape)]


def test_the_layers_fill_the_parameters() -> None:
    theta = initial(SHAPE, 2, RNG)
    of = layers(theta, SHAPE)
    assert [a.shape[1:] for a in of] == [(7, 6), (1, 6), (7, 5), (1, 5), (5, 1), (1, 1)]
    assert sum(a.size for a in of) == theta.size == 2 * SHAPE.parameters
    of.w3[1, 4, 0] = 123.0
    assert (theta == 123.0).sum() == 1


def test_the_action_enters_the_critics_last_hidden_layer() -> None:
    theta = initial(SHAPE, 1, RNG)
    states = random(3, 7)
    low, high = (
        forward(layers(theta, SHAPE), states, np.full(3, a, np.float32)) for a in (-1.0, 1.0)
    )
    assert np.array_equal(low.z[:, :, :-1], high.z[:, :, :-1])
    assert np.array_equal(high.z[0, :, -1], np.ones(3))
    assert not np.array_equal(low.h2, high.h2)
    assert layers(theta, SHAPE).w2.shape == (1, SHAPE.h1 + 1, SHAPE.h2)


def test_the_first_actions_are_small() -> None:
    theta = initial(Shape(7, 64, 64), 1, np.random.default_rng(0))
    assert np.abs(np.tanh(forward(layers(theta, Shape(7, 64, 64)), random(50, 7)).out)).max() < 0.1


def test_gradients_equal_torchs() -> None:
    theta = initial(SHAPE, 2, RNG)
    states, actions, g_out = random(9, 7), random(9), random(2, 9)
    gradient = np.full_like(theta, np.nan)
    of = layers(theta, SHAPE)
    seen = forward(of, states, actions)
    by_z = backward(of, seen, g_out, layers(gradient, SHAPE))
    for row in range(2):
        parameters = as_torch(theta, SHAPE, row)
        given = torch.tensor(actions, requires_grad=True)
        out = torch_critic(parameters, torch.tensor(states), given)
        assert seen.out[row] == pytest.approx(out.detach().numpy(), abs=1e-5)
        (out * torch.tensor(g_out[row])).sum().backward()
        expected = np.concatenate([p.grad.numpy().ravel() for p in parameters])
        assert gradient[row] == pytest.approx(expected, abs=1e-4)
        assert by_z[row, :, -1] == pytest.approx(given.grad.numpy(), abs=1e-4)


def test_adam_equals_torchs() -> None:
    ours = Trained(SHAPE, 1, RNG)
    theirs = torch.tensor(ours.theta.copy(), requires_grad=True)
    optimizer = torch.optim.Adam([theirs], lr=0.01)
    for number in range(1, 6):
        gradient = random(1, SHAPE.parameters)
        ours._gradient[:] = gradient
        theirs.grad = torch.tensor(gradient)
        ours.descend(0.01, number)
        optimizer.step()
    assert ours.theta == pytest.approx(theirs.detach().numpy(), abs=1e-6)


def test_a_soft_update_moves_the_target_by_tau() -> None:
    networks = Trained(SHAPE, 2, RNG)
    networks.theta[:] = 3.0
    networks.target[:] = 1.0
    networks.soft_update(0.25)
    assert np.all(networks.target == 1.5)
    assert np.all(networks.target_layers.w2 == 1.5)


def test_the_target_has_the_smaller_q_and_no_reward_after_a_terminal_state() -> None:
    actor = Trained(Shape(7, 6, 5), 1, RNG)
    critics = Trained(SHAPE, 2, RNG)
    critics.target[:] = RNG.normal(size=critics.target.shape)
    batch = Batch(
        random(4, 7), random(4), random(4), random(4, 7), np.array([0, 0, 0, 1], np.float32)
    )
    noise = np.array([0.0, 0.1, -0.1, 5.0], np.float32)
    loss = critic_update(actor, critics, batch, noise, 0.9)

    next_states = torch.tensor(batch.next_states)
    next_action = torch_actor(as_torch(actor.target, Shape(7, 6, 5)), next_states)
    next_action = torch.clip(next_action + torch.tensor(noise), -1, 1)
    targets = [as_torch(critics.target, SHAPE, k) for k in range(2)]
    next_q = torch.minimum(*(torch_critic(of, next_states, next_action) for of in targets))
    td_target = torch.tensor(batch.rewards) + 0.9 * next_q * torch.tensor(1 - batch.ended)
    td_target = td_target.detach()
    assert float(td_target[3]) == pytest.approx(float(batch.rewards[3]))
    total = 0.0
    for k in range(2):
        parameters = as_torch(critics.theta, SHAPE, k)
        q = torch_critic(parameters, torch.tensor(batch.states), torch.tensor(batch.actions))
        error = ((q - td_target) ** 2).mean()
        error.backward()
        total += error.item() / 2
        of = np.concatenate([p.grad.numpy().ravel() for p in parameters])
        assert critics._gradient[k] == pytest.approx(of, abs=1e-4)
    assert loss == pytest.approx(total, rel=1e-4)


def test_the_actor_follows_the_first_critic() -> None:
    shape = Shape(7, 6, 5)
    actor, critics = Trained(shape, 1, RNG), Trained(SHAPE, 2, RNG)
    critics.theta[:] = RNG.normal(size=critics.theta.shape)
    states = random(8, 7)
    actor_update(actor, critics, SHAPE, states)
    parameters = as_torch(actor.theta, shape)
    actions = torch_actor(parameters, torch.tensor(states))
    loss = -torch_critic(as_torch(critics.theta, SHAPE, 0), torch.tensor(states), actions).mean()
    loss.backward()
    expected = np.concatenate([p.grad.numpy().ravel() for p in parameters])
    assert actor._gradient[0] == pytest.approx(expected, abs=1e-5)
