"""What changes the weights in training: SGD, AdamW, or Muon for the large layers beside AdamW.

Muon (Jordan et al. 2024) steps along the gradient with all its singular values made equal, in as
many directions as a layer has; in short trials `fast` needed half the images. It has the layers
whose matrix is cheap: the convolutions and the first shared layer. What is small, and the wide
second shared layer, stays with AdamW; so do torchvision's backbones, whose thin layers have few
directions.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import SGD, AdamW, Muon, Optimizer

from mtlnet.model.network import Network
from mtlnet.training.recipes import MOMENTUM, Recipe

MUON_LAYERS = ("features.", "shared.fc0.")
MUON_SIDE = 1024
"""Directions of a layer at most. The work grows with their square: the 4096 of network
`deepdriving` cost two cores twenty seconds a step."""
MUON_RATE = 8.0
"""Times the recipe's rate: with updates scaled to AdamW's size, Muon bears longer steps."""


class Optimisers:
    """The optimisers of a network, stepped together; `beside`: parameters that never decay."""

    def __init__(self, network: Network, recipe: Recipe, beside: Sequence[nn.Parameter]) -> None:
        self.parts: list[Optimizer] = []
        self.parameters = [*network.parameters(), *beside]
        self._rows: list[tuple[nn.Parameter, nn.Parameter]] = []
        if recipe.optimiser == "sgd":
            # The gradient of l2 * |w|^2 is 2 * l2 * w.
            groups = _groups(list(network.parameters()), 2 * recipe.l2, beside)
            self.parts.append(SGD(groups, recipe.learning_rate, MOMENTUM, fused=True))
            return
        weights = {name: p for name, p in network.named_parameters() if p.ndim > 1}
        others = [p for p in network.parameters() if p.ndim <= 1]
        if recipe.optimiser == "muon" and not network.architecture.backbone:
            large = [name for name, weight in weights.items() if has_muon(name, weight)]
            self._rows = [(p, nn.Parameter(as_rows(p.detach()))) for p in map(weights.pop, large)]
            rows = [{"params": [row for _, row in self._rows], "times": MUON_RATE}]
            rate = recipe.learning_rate * MUON_RATE
            self.parts.append(GramMuon(rows, rate, recipe.l2))
        groups = _groups(list(weights.values()), recipe.l2, [*others, *beside])
        self.parts.append(AdamW(groups, recipe.learning_rate, betas=(0.9, 0.99), fused=True))

    def gradients(self) -> list[Tensor]:
        """Those there are, to be averaged over processes."""
        return [p.grad for p in self.parameters if p.grad is not None]

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for parameter in self.parameters:
            parameter.grad = None

    def set_rate(self, rate: float) -> None:
        """The learning rate from now on."""
        for part in self.parts:
            for group in part.param_groups:
                group["lr"] = rate * group.get("times", 1.0)

    @property
    def rate(self) -> float:
        """The learning rate."""
        group = self.parts[-1].param_groups[0]
        return float(group["lr"])

    def step(self) -> None:
        """Change the weights by their gradients."""
        for parameter, row in self._rows:
            row.grad = None if parameter.grad is None else as_rows(parameter.grad)
        for part in self.parts:
            part.step()


def has_muon(name: str, weight: Tensor) -> bool:
    """Whether a layer is Muon's."""
    return name.startswith(MUON_LAYERS) and min(as_rows(weight).shape) <= MUON_SIDE


def as_rows(weight: Tensor) -> Tensor:
    """A layer's weights (F, C, H, W) or (F, C) as a matrix (F, all else), of the same memory.

    The order of its columns, here of channels-last memory, means nothing to Muon.
    """
    return weight if weight.ndim == 2 else weight.permute(0, 2, 3, 1).flatten(1)


def _groups(
    decaying: list[nn.Parameter], decay: float, others: Sequence[nn.Parameter]
) -> list[dict[str, object]]:
    groups: list[dict[str, object]] = [{"params": decaying, "weight_decay": decay}]
    if others:
        groups.append({"params": list(others), "weight_decay": 0.0})
    return groups


# Muon with its iteration on the Gram matrix, in float32. A step goes along the gradient with its
# singular values made (nearly) equal, by five steps of Newton and Schulz. torch's Muon takes them
# on the whole matrix in bf16, which suits a GPU; a CPU without bf16 spends more on that than on
# the rest of a training step. Every one of those steps multiplies by a polynomial of the matrix's
# Gram matrix: so they are taken on that, which is small, and the large matrix is read twice
# instead of ten times.


RMS_OF_ADAMW = 0.2
"""Steps have the size of AdamW's: this times the root of the matrix's longer side."""


class GramMuon(Muon):
    """Muon for matrices (F, C); its state is that of torch's."""

    def __init__(self, params: Iterable[Any], lr: float, weight_decay: float) -> None:
        super().__init__(params, lr, weight_decay, adjust_lr_fn="match_rms_adamw")

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Change the weights by their gradients; a `closure` is not asked."""
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.grad is not None:
                    self._change(weight, weight.grad, group)

    def _change(self, weight: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        rate, momentum = group["lr"], group["momentum"]
        state = self.state[weight]
        if "momentum_buffer" not in state:
            state["momentum_buffer"] = torch.zeros_like(gradient)
        mean = state["momentum_buffer"]
        mean.lerp_(gradient, 1 - momentum)
        direction = gradient.lerp(mean, momentum)
        length = rate * RMS_OF_ADAMW * max(weight.shape) ** 0.5
        weight.mul_(1 - rate * group["weight_decay"])
        weight.add_(
            orthogonalize(direction, group["ns_coefficients"], group["ns_steps"], group["eps"]),
            alpha=-length,
        )


def orthogonalize(
    matrix: Tensor, coefficients: tuple[float, float, float], steps: int, least: float
) -> Tensor:
    """`matrix` (F, C) with its singular values brought near 1; `least`: the smallest norm."""
    wide = matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T
    wide = wide / wide.norm().clamp(min=least)
    first, second, third = coefficients
    gram, product = wide @ wide.T, None
    for left in reversed(range(steps)):
        factor = torch.addmm(gram, gram, gram, beta=second, alpha=third)
        factor.diagonal().add_(first)
        # Polynomials of one matrix: their order does not matter.
        product = factor if product is None else factor @ product
        if left:
            gram = factor @ gram @ factor
    assert product is not None
    even: Tensor = product @ wide
    return even if matrix.shape[0] <= matrix.shape[1] else even.T
