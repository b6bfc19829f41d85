"""Proximal policy optimisation (Schulman et al. 2017) on torch, in the form of CleanRL.

The policy is a normal distribution of the steering around the actor's action, with a learned
standard deviation that does not depend on the state. Advantages are generalised advantage estimates
(Schulman et al. 2016). Differences from CleanRL's `ppo_continuous_action.py`:

- The hidden layers have ReLU, and the mean action is odd: half the difference between tanh of the
  network's outputs for the state and for its mirror image, as in the actor's files of `td3`.
- If an episode ends by its number of steps, the value of its last state replaces later rewards.
- The discount factor of a step depends on the distance driven in it, not on its duration: a slow
  car needs more steps, but not more metres, to return to the middle of the road.
- Advantages are divided by their typical size in the same state, which the critic's second output
  learns. Without this the start, where the car is slow and the advantages are small, would have
  little weight, although most of the score is lost there. Then advantages are divided by their mean
  absolute deviation and clipped at 4 times this deviation, because an early end costs hundreds of
  times as much as a usual step.
- The critic also receives the exact state and the road ahead (`privileged`).
- The standard deviation of the steering is at least 0.05.
- The gradients of actor and critic are clipped separately; the value's loss is not clipped, and
  there is no bonus for entropy.
- Rewards and states are scaled by constants instead of running means.
"""

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from controllers.laws.actor import NAMES, mirror_of
from controllers.laws.actor_state import StateDefinition
from controllers.rl import privileged
from controllers.rl.advantages import advantages_of, discounts_at
from controllers.rl.cars import Array, Step
from controllers.rl.checkpoint import Tensors
from controllers.rl.config import PpoSettings

ADAM_EPSILON = 1e-5
SIZE_FLOOR, SIZE_WEIGHT = 0.01, 0.1
"""SIZE_FLOOR is added to the absolute value of an advantage before its logarithm is taken.
SIZE_WEIGHT is the weight of the loss of this logarithm, relative to the loss of the value."""
ADVANTAGE_LIMIT = 4.0
V_X_AT = privileged.PARTS.index("v_x") - privileged.SIZE
"""Index, counted from the end, of v_x in a state that is followed by its privileged state."""
LEAST_STD = 0.05
"""Least standard deviation of the steering actions. Without it the standard deviation falls to 0.02
within 1.5 million steps, and the score stops improving."""
LOG_SQRT_2PI = 0.5 * math.log(2.0 * math.pi)


def scaled(advantages: Tensor) -> Tensor:
    """Return `advantages` (B,) minus their mean, divided by their mean absolute deviation and
    clipped to +-4."""
    centred = advantages - advantages.mean()
    return (centred / (centred.abs().mean() + 1e-8)).clamp(-ADVANTAGE_LIMIT, ADVANTAGE_LIMIT)


def clipped_loss(log_ratio: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """Return the loss -mean min(r A, clip(r, 1 - clip, 1 + clip) A) with r = exp(`log_ratio`) and
    the `advantages` A, both (B,)."""
    ratio = log_ratio.exp()
    limited = ratio.clamp(1.0 - clip, 1.0 + clip)
    return -torch.min(ratio * advantages, limited * advantages).mean()


def log_density(actions: Tensor, means: Tensor, log_std: Tensor) -> Tensor:
    """Return the logarithms (B,) of the normal densities of `actions` (B,) around `means` (B,),
    with the standard deviation exp(`log_std`)."""
    z = (actions - means) * torch.exp(-log_std)
    return -0.5 * z * z - log_std - LOG_SQRT_2PI


class Policy(nn.Module):
    """The actor with its standard deviation, and the critic. The actor's input is a scaled state
    (B, size), the critic's a scaled state with its privileged state (B, size + 21)."""

    def __init__(
        self, definition: StateDefinition, settings: PpoSettings, generator: torch.Generator
    ) -> None:
        super().__init__()
        order, signs = mirror_of(definition)
        self._order, self._signs = torch.from_numpy(order), torch.from_numpy(signs)
        size, hidden = definition.size, settings.hidden
        self.actor = _layers(size, hidden, 0.01, generator)
        self.critic = _layers(size + privileged.SIZE, hidden, 1.0, generator, outputs=2)
        self.log_std = nn.Parameter(torch.tensor(math.log(settings.first_std)))

    def mean(self, states: Tensor) -> Tensor:
        """Return the mean actions (B,), in (-1, 1), for scaled states (B, size)."""
        first, second, last = (layer for layer in self.actor if isinstance(layer, nn.Linear))
        # One product computes the first layer for the states and for their mirror images.
        mirrored = (first.weight * self._signs)[:, self._order]
        weight, bias = torch.cat((first.weight, mirrored)), first.bias.repeat(2)
        hidden = nn.functional.linear(states, weight, bias).relu().view(-1, len(first.bias))
        out = torch.tanh(last(second(hidden).relu())).view(-1, 2)
        return 0.5 * (out[:, 0] - out[:, 1])

    def value(self, states: Tensor) -> Tensor:
        """Return the values (B,) of scaled states with privileged states (B, size + 21)."""
        return self.value_and_size(states)[0]

    def value_and_size(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Return for scaled states with privileged states (B, size + 21) the values (B,), and the
        logarithms (B,) of the typical size of an advantage."""
        values, sizes = self.critic(states).unbind(1)
        return values, sizes


def _layers(
    size: int,
    hidden: tuple[int, int],
    gain: float,
    generator: torch.Generator,
    outputs: int = 1,
) -> nn.Sequential:
    """Make two hidden layers with ReLU and an output layer, with orthogonal initial weights."""
    widths = (size, *hidden, outputs)
    linears = [nn.Linear(*pair) for pair in pairwise(widths)]
    for linear, factor in zip(linears, (math.sqrt(2.0), math.sqrt(2.0), gain), strict=True):
        nn.init.orthogonal_(linear.weight, factor, generator=generator)
        nn.init.zeros_(linear.bias)
    first, second, last = linears
    return nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), last)


@dataclass
class Rollout:
    """The last T steps of N cars. `states` (before each step) and `last` (after it) are scaled
    states with privileged states (T, N, size + 21); all other arrays are (T, N)."""

    states: Array
    last: Array
    actions: Array
    rewards: Array
    ended: NDArray[np.bool_]
    over: NDArray[np.bool_]

    @classmethod
    def empty(cls, horizon: int, cars: int, size: int) -> "Rollout":
        states, last = np.zeros((2, horizon, cars, size + privileged.SIZE), np.float32)
        actions, rewards = np.zeros((2, horizon, cars), np.float32)
        ended, over = np.zeros((2, horizon, cars), np.bool_)
        return cls(states, last, actions, rewards, ended, over)


class Ppo:
    """PPO with N cars. In each control step `explore` is called once, then `learn`."""

    def __init__(
        self,
        settings: PpoSettings,
        definition: StateDefinition,
        cars: int,
        seed: int,
        threads: int = 1,
    ) -> None:
        """`cars` is N. With 2 `threads` or more, actor and critic are updated at the same time. The
        networks do not depend on `threads`."""
        self.settings, self.odd = settings, True
        self.horizon = settings.horizon
        self.policy = Policy(definition, settings, torch.Generator().manual_seed(seed))
        self._actor_adam, self._critic_adam = (
            torch.optim.Adam(parameters, eps=ADAM_EPSILON, fused=True)
            for parameters in (
                [*self.policy.actor.parameters(), self.policy.log_std],
                list(self.policy.critic.parameters()),
            )
        )
        self._beside = ThreadPoolExecutor(1) if threads > 1 else None
        self.divisor = np.array(definition.spread, np.float32)
        self._rollout = Rollout.empty(self.horizon, cars, definition.size)
        self._filled = 0

    def act(self, states: Array) -> Array:
        """Return the mean actions (N,) for states (N, size)."""
        with torch.no_grad():
            means: Array = self.policy.mean(torch.from_numpy(states / self.divisor)).numpy()
        return means

    def explore(self, states: Array, rng: np.random.Generator) -> Array:
        """Return random actions (N,) for states (N, size); they can lie outside [-1, 1]."""
        noise = rng.standard_normal(len(states), np.float32)
        return self.act(states) + noise * np.float32(math.exp(self.policy.log_std.item()))

    def learn(
        self, states: Array, actions: Array, step: Step, rng: np.random.Generator, left: float
    ) -> dict[str, float]:
        """Add a step of all cars to the rollout; update the networks after every `horizon` steps.
        Returns the losses and other measures of the update by name, {} without an update.

        `left`: share of the training that remains, from 1 down to 0.
        """
        of, row, k = self.settings, self._rollout, self._filled
        row.states[k] = np.hstack((states / self.divisor, step.privileged))
        row.last[k] = np.hstack((step.last / self.divisor, step.last_privileged))
        row.actions[k] = actions
        baseline = of.reward_baseline * (1 + of.end_steps * step.ended)
        row.rewards[k] = of.reward_scale * (step.rewards - baseline)
        row.ended[k], row.over[k] = step.ended, step.over
        self._filled = (k + 1) % self.horizon
        if self._filled:
            return {}
        share = of.rate_end + (1.0 - of.rate_end) * left
        self._actor_adam.param_groups[0]["lr"] = of.actor_rate * share
        self._critic_adam.param_groups[0]["lr"] = of.critic_rate * share
        return self._update(rng)

    def _update(self, rng: np.random.Generator) -> dict[str, float]:
        of, row = self.settings, self._rollout
        shape = row.actions.shape
        states = torch.from_numpy(row.states.reshape(-1, row.states.shape[2]))
        actions = torch.from_numpy(row.actions.reshape(-1))
        with torch.no_grad():
            values, sizes = self.policy.value_and_size(states)
            before = log_density(actions, self._means(states), self.policy.log_std)
            next_values = self._next_values(values.numpy().reshape(shape))
        speeds = row.states[:, :, V_X_AT] * privileged.SPREAD[V_X_AT]
        advantages = advantages_of(
            row.rewards,
            values.numpy().reshape(shape),
            next_values,
            row.ended,
            row.over,
            discounts_at(speeds, of.discount_length_m),
            of.gae_lambda,
        )
        gained = torch.from_numpy(advantages.reshape(-1))
        returns = gained + values
        wanted = torch.stack((returns, (gained.abs() + SIZE_FLOOR).log()), dim=1)
        gained = gained / sizes.exp()
        orders = [torch.from_numpy(rng.permutation(len(states))) for _ in range(of.epochs)]
        of_actor = states, torch.stack((actions, before, gained), dim=1)
        if self._beside is None:
            actor, kl = self._improve_actor(orders, *of_actor)
            critic = self._improve_critic(orders, states, wanted)
        else:
            improving = self._beside.submit(self._improve_actor, orders, *of_actor)
            critic = self._improve_critic(orders, states, wanted)
            actor, kl = improving.result()
        explained = 1.0 - float((returns - values).var() / (returns.var() + 1e-8))
        return {
            "loss": critic,
            "actor_loss": actor,
            "kl": kl,
            "std": math.exp(self.policy.log_std.item()),
            "explained_variance": explained,
            "reward": float(row.rewards.mean()),
            "ended_share": float(row.ended.mean()),
        }

    def _next_values(self, values: Array) -> Array:
        """Return the critic's values (T, N) of the states after T steps of N cars. `values` (T, N)
        are its values of the states before the steps."""
        row = self._rollout
        found = np.empty_like(values)
        found[:-1] = values[1:]
        asked = row.over.copy()
        asked[-1] = True
        found[asked] = self.policy.value(torch.from_numpy(row.last[asked])).numpy()
        return found

    def _means(self, states: Tensor) -> Tensor:
        """Return the mean actions (B,) for scaled states with privileged states."""
        return self.policy.mean(states[:, : len(self.divisor)])

    def _improve_actor(
        self, orders: list[Tensor], states: Tensor, targets: Tensor
    ) -> tuple[float, float]:
        """Train the actor for all epochs; returns the means of its loss and of its KL divergence
        from the policy before the update.

        `orders`: a random order for each epoch. `states` (B, size + 21). `targets` (B, 3): action,
        logarithm of its density before the update, advantage.
        """
        policy, found = self.policy, []
        for batch, chosen in self._minibatches(orders, states, targets):
            actions, before, gained = chosen.unbind(1)
            log_ratio = log_density(actions, self._means(batch), policy.log_std) - before
            loss = clipped_loss(log_ratio, scaled(gained), self.settings.clip)
            self._descend(loss, self._actor_adam)
            with torch.no_grad():
                policy.log_std.clamp_(min=math.log(LEAST_STD))
                kl = (log_ratio.exp() - 1.0 - log_ratio).mean()
            found.append((loss.item(), kl.item()))
        mean_loss, mean_kl = np.mean(found, axis=0).tolist()
        return mean_loss, mean_kl

    def _improve_critic(self, orders: list[Tensor], states: Tensor, wanted: Tensor) -> float:
        """Train the critic for all epochs; returns the mean loss of its values.

        `wanted` (B, 2): the return, and the logarithm of the absolute value of the advantage."""
        losses = []
        for batch, targets in self._minibatches(orders, states, wanted):
            value, size = 0.5 * ((self.policy.critic(batch) - targets) ** 2).mean(dim=0)
            self._descend(value + SIZE_WEIGHT * size, self._critic_adam)
            losses.append(value.item())
        return float(np.mean(losses))

    def _minibatches(
        self, orders: list[Tensor], states: Tensor, targets: Tensor
    ) -> Iterator[tuple[Tensor, Tensor]]:
        for order in orders:
            parts = (part[order].chunk(self.settings.minibatches) for part in (states, targets))
            yield from zip(*parts, strict=True)

    def _descend(self, loss: Tensor, adam: torch.optim.Adam) -> None:
        """Change the parameters of `adam` by one step of Adam, with a limited gradient."""
        adam.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(adam.param_groups[0]["params"], self.settings.max_gradient)
        adam.step()

    def weights(self) -> dict[str, Array]:
        """Return the arrays of an actor's file (w1, b1, w2, b2, w3, b3)."""
        linears = [layer for layer in self.policy.actor if isinstance(layer, nn.Linear)]
        w1, w2, w3 = (linear.weight.detach().numpy().T.copy() for linear in linears)
        b1, b2, b3 = (linear.bias.detach().numpy().copy() for linear in linears)
        return dict(zip(NAMES, (w1, b1, w2, b2, w3[:, 0].copy(), b3), strict=True))

    def store(self) -> tuple[Tensors, dict[str, int]]:
        """Return all arrays that a continued training needs, by name; there are no counts."""
        tensors: Tensors = {}
        for name, parameter, moments in self._parameters():
            tensors[f"policy.{name}"] = parameter.detach().numpy()
            for part, value in moments.items():
                tensors[f"adam.{name}.{part}"] = value.numpy()
        return tensors, {}

    def restore(self, tensors: Tensors, counts: dict[str, int]) -> None:
        """Restore the arrays that `store` returned. Raises ValueError for another shape."""
        for name, parameter, moments in self._parameters():
            stored = torch.from_numpy(tensors[f"policy.{name}"])
            if stored.shape != parameter.shape:
                raise ValueError(f"{name} has the shape {tuple(stored.shape)}")
            parameter.data.copy_(stored)
            for part in ("step", "exp_avg", "exp_avg_sq"):
                moments[part] = torch.from_numpy(tensors[f"adam.{name}.{part}"].copy())

    def _parameters(self) -> Iterator[tuple[str, nn.Parameter, dict[str, Any]]]:
        """Yield the name, the values and Adam's moments of each parameter."""
        for name, parameter in self.policy.named_parameters():
            adam = self._critic_adam if name.startswith("critic.") else self._actor_adam
            yield name, parameter, adam.state[parameter]
