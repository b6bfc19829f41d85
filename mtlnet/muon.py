"""Muon with its iteration on the Gram matrix, in float32.

A step goes along the gradient with its singular values made (nearly) equal, by five steps of Newton
and Schulz. torch's Muon takes them on the whole matrix in bf16, which suits a GPU; a CPU without
bf16 spends more on that than on the rest of a training step. Every one of those steps multiplies by
a polynomial of the matrix's Gram matrix: so they are taken on that, which is small, and the large
matrix is read twice instead of ten times.
"""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim import Muon

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
            evened(direction, group["ns_coefficients"], group["ns_steps"], group["eps"]),
            alpha=-length,
        )


def evened(
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
