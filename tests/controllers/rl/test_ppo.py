"""PPO: advantages and losses against closed forms and slow loops, the actor's file, learning."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from controllers.laws.actor import Actor, ActorCard
from controllers.laws.actor_state import HISTORY, PAPER, STATES
from controllers.rl import privileged
from controllers.rl.advantages import advantages_of, discounts_at
from controllers.rl.cars import Step
from controllers.rl.config import PpoSettings

torch = pytest.importorskip("torch")

from controllers.rl.ppo import Ppo, clipped_loss, log_density, scaled  # noqa: E402

RNG = np.random.default_rng(3)
NOTHING = np.zeros((4, 1), np.bool_)
SIZE = 7 + privileged.SIZE


def column(*values: float) -> np.ndarray:
    return np.array(values, np.float32)[:, None]


def every(discount: float) -> np.ndarray:
    return column(*[discount] * 4)


def test_advantages_of_a_constant_reward() -> None:
    """Values 0: the errors are the rewards, so that the sum is geometric."""
    zeros = column(0, 0, 0, 0)
    found = advantages_of(column(1, 1, 1, 1), zeros, zeros, NOTHING, NOTHING, every(0.8), 0.5)
    assert found[:, 0] == pytest.approx([1 + 0.4 + 0.16 + 0.064, 1 + 0.4 + 0.16, 1.4, 1.0])


def test_with_lambda_1_advantages_are_discounted_returns_minus_values() -> None:
    values = column(3, 1, -2, 5)
    next_values = np.vstack((values[1:], column(7)))
    found = advantages_of(
        column(1, 2, 3, 4), values, next_values, NOTHING, NOTHING, every(0.9), 1.0
    )
    returns = 1 + 0.9 * 2 + 0.81 * 3 + 0.729 * 4 + 0.6561 * 7
    assert float(found[0, 0]) == pytest.approx(returns - 3, rel=1e-6)
    assert float(found[3, 0]) == pytest.approx(4 + 0.9 * 7 - 5)


def test_advantages_equal_the_sum_of_their_definition() -> None:
    steps, cars, decay = 12, 5, 0.9
    discounts = RNG.uniform(0.9, 1.0, (steps, cars)).astype(np.float32)
    rewards, values, next_values = RNG.normal(size=(3, steps, cars)).astype(np.float32)
    ended = RNG.random((steps, cars)) < 0.15
    over = ended | (RNG.random((steps, cars)) < 0.2)
    found = advantages_of(rewards, values, next_values, ended, over, discounts, decay)
    for car in range(cars):
        for start in range(steps):
            total, factor = 0.0, 1.0
            for t in range(start, steps):
                following = 0.0 if ended[t, car] else discounts[t, car] * next_values[t, car]
                total += factor * (rewards[t, car] + following - values[t, car])
                factor *= discounts[t, car] * decay
                if over[t, car]:
                    break
            assert float(found[start, car]) == pytest.approx(total, abs=1e-5)


def test_discounts_fall_with_the_distance_driven() -> None:
    """20 m/s are 1 m in a step; below 1 m/s the distance is that of 1 m/s."""
    found = discounts_at(np.array([[20.0, 1.0, -3.0]], np.float32), 25.0)
    assert found[0].tolist() == pytest.approx([math.exp(-0.04), *[math.exp(-0.002)] * 2])


def test_the_loss_is_clipped_on_the_side_that_would_gain() -> None:
    """Ratios 1.5 and 0.5 with advantages of both signs, clipped at 1.2 and 0.8."""
    ratios, advantages = [1.5, 1.5, 0.5, 0.5, 1.1], [2.0, -2.0, 2.0, -2.0, 1.0]
    log_ratio = torch.tensor(ratios).log().requires_grad_()
    loss = clipped_loss(log_ratio, torch.tensor(advantages), 0.2)
    loss.backward()  # type: ignore[no-untyped-call]
    assert loss.item() == pytest.approx(-(2.4 - 3.0 + 1.0 - 1.6 + 1.1) / 5)
    assert log_ratio.grad.tolist() == pytest.approx([0.0, 3.0 / 5, -1.0 / 5, 0.0, -1.1 / 5])


def test_one_large_advantage_does_not_hide_the_others() -> None:
    """0, 2 and 4 are at most 2 from their mean; their mean distance is 4 / 3."""
    assert scaled(torch.tensor([0.0, 2.0, 4.0])).tolist() == pytest.approx([-1.5, 0.0, 1.5])
    usual = [0.1, -0.1] * 50
    found = scaled(torch.tensor([*usual, -30.0]))
    assert found[-1].item() == -4.0
    assert (found[0] - found[1]).item() == pytest.approx(0.2 / 0.5882, rel=0.02)


def test_the_density_is_that_of_the_normal_distribution() -> None:
    actions, means = torch.tensor([0.3, -0.2]), torch.tensor([0.1, 0.4])
    expected = torch.distributions.Normal(means, 0.25).log_prob(actions)
    found = log_density(actions, means, torch.tensor(0.25).log())
    assert found.tolist() == pytest.approx(expected.tolist(), rel=1e-6)


@pytest.mark.parametrize("name", ["paper", "history"])
def test_the_actors_file_steers_as_the_policy(name: str) -> None:
    definition = STATES[name]
    ppo = Ppo(PpoSettings(hidden=(16, 8)), definition, 2, 0)
    last: Any = ppo.policy.actor[-1]
    last.weight.data *= 100.0
    card = ActorCard(
        *(definition.name, definition.parts, 5.5, tuple(ppo.divisor.tolist()), True, (16, 8)),
        *("ppo", "all", 0, 0, 0.0),
    )
    actor = Actor(card, ppo.weights())
    states = RNG.normal(size=(20, definition.size)).astype(np.float32) * ppo.divisor
    mirrored = states[:, list(definition.order)] * np.array(definition.odd, np.float32)
    actions = ppo.act(states)
    assert np.abs(actions).max() > 0.1
    assert actions == pytest.approx([actor.steer(state) for state in states], abs=1e-5)
    assert actions == pytest.approx(-ppo.act(mirrored), abs=1e-6)


def step_of(
    states: np.ndarray,
    rewards: np.ndarray,
    ended: np.ndarray,
    exact: np.ndarray | None = None,
) -> Step:
    if exact is None:
        exact = np.zeros((len(states), privileged.SIZE), np.float32)
    return Step(states, states, exact, exact, rewards, ended, ended, np.zeros(len(states)))


def test_ppo_learns_the_best_action_of_a_bandit() -> None:
    """Reward 1 - |action - d / 4|, where each step is an episode; d is the first number."""
    cars, rng = 64, np.random.default_rng(0)
    settings = replace(
        PpoSettings(), horizon=16, minibatches=4, actor_rate=3e-3, reward_baseline=0.0
    )
    ppo = Ppo(settings, PAPER, cars, 0)
    ended = np.ones(cars, np.bool_)
    figures: dict[str, float] = {}
    for number in range(16 * 20):
        states = np.zeros((cars, 7), np.float32)
        states[:, 0] = rng.uniform(-0.1, 0.1, cars)
        actions = ppo.explore(states, rng)
        rewards = 1.0 - np.abs(actions - states[:, 0] / 0.4)
        found = ppo.learn(states, actions, step_of(states, rewards, ended), rng, 1.0)
        assert bool(found) == (number % 16 == 15)
        figures = found or figures
    asked = np.zeros((2, 7), np.float32)
    asked[:, 0] = 0.08, -0.04
    assert ppo.act(asked) == pytest.approx([0.2, -0.1], abs=0.03)
    assert figures["std"] < 0.12
    assert figures["reward"] > 0.9


def test_the_critic_knows_what_the_actor_does_not_see() -> None:
    """Each step is an episode, whose reward is a number of the privileged state alone."""
    cars, rng = 64, np.random.default_rng(0)
    settings = replace(PpoSettings(), horizon=16, minibatches=4, reward_baseline=0.0)
    ppo = Ppo(settings, PAPER, cars, 0)
    states, ended = np.zeros((cars, 7), np.float32), np.ones(cars, np.bool_)
    figures: dict[str, float] = {}
    for _ in range(16 * 10):
        exact = rng.normal(size=(cars, privileged.SIZE)).astype(np.float32)
        step = step_of(states, exact[:, 9].astype(float), ended, exact)
        figures = ppo.learn(states, ppo.explore(states, rng), step, rng, 1.0) or figures
    assert figures["explained_variance"] > 0.95


def test_the_critic_learns_the_size_of_an_advantage() -> None:
    """Rewards spread by 2 where a number of the privileged state is above 0, by 0.2 elsewhere."""
    cars, rng = 64, np.random.default_rng(0)
    settings = replace(PpoSettings(), horizon=16, minibatches=4, reward_baseline=0.0)
    ppo = Ppo(settings, PAPER, cars, 0)
    states, ended = np.zeros((cars, 7), np.float32), np.ones(cars, np.bool_)
    for _ in range(16 * 20):
        exact = np.zeros((cars, privileged.SIZE), np.float32)
        exact[:, 9] = rng.choice([-1.0, 1.0], cars)
        rewards = rng.choice([-1.0, 1.0], cars) * np.where(exact[:, 9] > 0.0, 2.0, 0.2)
        ppo.learn(
            states, ppo.explore(states, rng), step_of(states, rewards, ended, exact), rng, 1.0
        )
    asked = torch.zeros(2, SIZE)
    asked[:, 7 + 9] = torch.tensor([-1.0, 1.0])
    sizes = ppo.policy.value_and_size(asked)[1].exp()
    assert sizes.tolist() == pytest.approx([0.21, 2.01], rel=0.25)


def test_a_terminal_state_costs_the_baseline_of_many_steps() -> None:
    ppo = Ppo(PpoSettings(end_steps=9, reward_baseline=1.0, reward_scale=2.0), PAPER, 2, 0)
    states = np.zeros((2, 7), np.float32)
    step = step_of(states, np.array([-2.0, 0.75]), np.array([True, False]))
    ppo.learn(states, np.zeros(2, np.float32), step, RNG, 1.0)
    assert ppo._rollout.rewards[0] == pytest.approx([2.0 * (-2.0 - 1.0 - 9.0), -0.5])


def test_a_cut_episode_continues_with_the_value_of_its_last_state() -> None:
    ppo = Ppo(PpoSettings(horizon=3), PAPER, 2, 0)
    rollout = ppo._rollout
    rollout.last[:] = RNG.normal(size=rollout.last.shape)
    rollout.over[0, 1] = True
    values = RNG.normal(size=(3, 2)).astype(np.float32)
    with torch.no_grad():
        found = ppo._next_values(values)
        last = torch.from_numpy(rollout.last.reshape(6, -1))
        of_last = ppo.policy.value(last).reshape(3, 2)
    assert found[0, 0] == values[1, 0]
    assert found[1].tolist() == values[2].tolist()
    assert found[0, 1] == pytest.approx(of_last[0, 1].item(), abs=1e-6)
    assert found[2] == pytest.approx(of_last[2].numpy(), abs=1e-6)


def test_the_standard_deviation_has_a_least_value() -> None:
    ppo = Ppo(replace(PpoSettings(), horizon=1, minibatches=1, first_std=0.01), PAPER, 8, 0)
    states = RNG.normal(size=(8, 7)).astype(np.float32)
    step = step_of(states, RNG.normal(size=8), np.zeros(8, np.bool_))
    figures = ppo.learn(states, ppo.explore(states, RNG), step, RNG, 1.0)
    assert figures["std"] == pytest.approx(0.05, rel=0.02)


def test_the_rates_fall_linearly() -> None:
    ppo = Ppo(
        replace(PpoSettings(), horizon=1, minibatches=1, actor_rate=1e-3, critic_rate=4e-3),
        PAPER,
        8,
        0,
    )
    states = RNG.normal(size=(8, 7)).astype(np.float32)
    step = step_of(states, RNG.normal(size=8), np.zeros(8, np.bool_))
    ppo.learn(states, RNG.normal(size=8).astype(np.float32), step, RNG, 0.25)
    adams = ppo._actor_adam, ppo._critic_adam
    assert [adam.param_groups[0]["lr"] for adam in adams] == [2.5e-4, 1e-3]


def test_the_history_has_the_last_eight_states() -> None:
    assert HISTORY.size == 56
    assert HISTORY.parts[:9] == (*PAPER.parts, "d_1", "angle_1")
    assert HISTORY.order[:8] == (0, 1, 2, 3, 6, 5, 4, 7)
    assert math.isclose(HISTORY.spread[7 * 3], 0.03)


def test_a_checkpoint_of_another_network_is_refused() -> None:
    """The critic of an earlier program had no privileged state and one output."""
    ppo = Ppo(PpoSettings(horizon=1, minibatches=1), PAPER, 8, 0)
    states = RNG.normal(size=(8, 7)).astype(np.float32)
    step = step_of(states, RNG.normal(size=8), np.zeros(8, np.bool_))
    ppo.learn(states, RNG.normal(size=8).astype(np.float32), step, RNG, 1.0)
    tensors, counts = ppo.store()
    tensors["policy.critic.4.weight"] = tensors["policy.critic.4.weight"][:1]
    with pytest.raises(ValueError, match=r"critic\.4\.weight has the shape \(1, 64\)"):
        ppo.restore(tensors, counts)
