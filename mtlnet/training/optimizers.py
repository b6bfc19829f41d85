"""Optimizers: SGD, AdamW, or Muon for the large layers with AdamW for all other layers.

Muon (Jordan et al. 2024) makes the singular values of a layer's gradient equal and steps along the
result. In short trials recipe `fast` needed half as many images with Muon. Muon trains the layers
whose matrix is cheap to process: the convolutions, the first shared layer and small shared layers.
AdamW trains heads, biases, wide shared layers, and torchvision's backbones, whose matrices have few
rows.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import SGD, AdamW, Muon, Optimizer

from mtlnet.model.network import Network
from mtlnet.training.recipes import MOMENTUM, Recipe

MUON_LAYERS = ("features.", "shared.fc0.")
"""Prefixes of the names of the convolutions and of the first shared layer."""
MUON_MAX_SIDE = 1024
"""Maximum of the shorter side of the matrices of `MUON_LAYERS`; AdamW trains larger matrices. The
cost of a step grows with the square of the shorter side: a matrix of network `deepdriving` has a
shorter side of 4096, and Muon's step then takes twenty seconds on two cores."""
MUON_MAX_SHARED_SIDE = 512
"""Maximum of the longer side of the matrix of a shared layer other than the first."""
MUON_LR_SCALE = 8.0
"""Ratio of Muon's learning rate to the recipe's. It is above 1, because Muon's updates are scaled
to the size of AdamW's, and Muon tolerates longer steps than AdamW."""


class OptimizerSet:
    """The one or two optimizers of a network, which step together.

    `extra`: further parameters, trained without weight decay. `capturable`: a step can be recorded
    as a CUDA graph. Learning rates are then tensors on the weights' device, and Muon processes
    layers of one size together.
    """

    def __init__(
        self,
        network: Network,
        recipe: Recipe,
        extra: Sequence[nn.Parameter],
        *,
        capturable: bool = False,
    ) -> None:
        self.optimizers: list[Optimizer] = []
        self.learning_rate = recipe.learning_rate
        """The recipe's learning rate at the current step, without `MUON_LR_SCALE`."""
        self.parameters = [*network.parameters(), *extra]
        self._matrices: list[tuple[nn.Parameter, nn.Parameter]] = []
        if recipe.optimizer == "sgd":
            # The gradient of l2 * |w|^2 is 2 * l2 * w.
            groups = _groups(list(network.parameters()), 2 * recipe.l2, extra)
            self.optimizers.append(SGD(groups, recipe.learning_rate, MOMENTUM, fused=True))
            self._keep_rates_as_tensors(capturable)
            return
        weights = {name: p for name, p in network.named_parameters() if p.ndim > 1}
        others = [p for p in network.parameters() if p.ndim <= 1]
        if recipe.optimizer == "muon" and not network.architecture.backbone:
            large = [name for name, weight in weights.items() if uses_muon(name, weight)]
            self._matrices = [
                (p, nn.Parameter(as_matrix(p.detach()))) for p in map(weights.pop, large)
            ]
            matrices = [matrix for _, matrix in self._matrices]
            muon_groups = [{"params": matrices, "lr_scale": MUON_LR_SCALE}]
            rate = recipe.learning_rate * MUON_LR_SCALE
            self.optimizers.append(GramMuon(muon_groups, rate, recipe.l2, together=capturable))
        groups = _groups(list(weights.values()), recipe.l2, [*others, *extra])
        betas = (0.9, 0.99)
        self.optimizers.append(
            AdamW(groups, recipe.learning_rate, betas, fused=True, capturable=capturable)
        )
        self._keep_rates_as_tensors(capturable)

    def _keep_rates_as_tensors(self, capturable: bool) -> None:
        """Replace the learning rates of all groups by tensors () on the weights' device."""
        if not capturable:
            return
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                device = group["params"][0].device
                group["lr"] = torch.tensor(group["lr"], dtype=torch.float32, device=device)

    def gradients(self) -> list[Tensor]:
        """Return the gradients of all parameters that have one, to be averaged over the
        processes."""
        return [p.grad for p in self.parameters if p.grad is not None]

    def zero_grad(self) -> None:
        """Delete the gradients."""
        for parameter in self.parameters:
            parameter.grad = None

    def set_learning_rate(self, rate: float) -> None:
        """Set the learning rate to `rate`; Muon's is 8 times as large."""
        self.learning_rate = rate
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                scaled = rate * group.get("lr_scale", 1.0)
                if isinstance(group["lr"], Tensor):
                    group["lr"].fill_(scaled)  # a recorded step reads this memory
                else:
                    group["lr"] = scaled

    def step(self) -> None:
        """Update the weights by their gradients."""
        for parameter, matrix in self._matrices:
            matrix.grad = None if parameter.grad is None else as_matrix(parameter.grad)
        for optimizer in self.optimizers:
            optimizer.step()


def uses_muon(name: str, weight: Tensor) -> bool:
    """Return whether Muon, not AdamW, trains the parameter `weight` called `name`."""
    sides = as_matrix(weight).shape
    if name.startswith("shared.") and max(sides) <= MUON_MAX_SHARED_SIDE:
        return True
    return name.startswith(MUON_LAYERS) and min(sides) <= MUON_MAX_SIDE


def as_matrix(weight: Tensor) -> Tensor:
    """Return a layer's weights (F, C, H, W) or (F, C) as a matrix (F, H * W * C) or (F, C), which
    shares the memory of `weight` if the weights are channels-last.

    The columns are in the order of channels-last memory; Muon does not depend on their order.
    """
    return weight if weight.ndim == 2 else weight.permute(0, 2, 3, 1).flatten(1)


def _groups(
    decaying: list[nn.Parameter], decay: float, others: Sequence[nn.Parameter]
) -> list[dict[str, object]]:
    groups: list[dict[str, object]] = [{"params": decaying, "weight_decay": decay}]
    if others:
        groups.append({"params": list(others), "weight_decay": 0.0})
    return groups


# Muon that iterates on the Gram matrix, in float32. Five Newton-Schulz iterations make the singular
# values of the gradient (nearly) equal. torch's Muon iterates on the whole matrix in bf16, which
# suits a GPU; on a CPU without bf16 the iterations take longer than the rest of a training step.
# Each iteration multiplies by a polynomial of the Gram matrix, so the iterations can run on the
# small Gram matrix. The large matrix is then read twice instead of ten times.


RMS_OF_ADAMW = 0.2
"""Root mean square of AdamW's updates, to which Muon's updates are scaled."""


class GramMuon(Muon):
    """Muon for matrices (F, C), which iterates on the Gram matrix of their shorter side. Its state
    has the form of the state of torch.optim.Muon.

    `together`: process the Gram matrices of one size as one batch. This is for a GPU, because the
    product of a single small matrix would leave most of its processors idle.
    """

    def __init__(
        self, params: Iterable[Any], lr: float, weight_decay: float, *, together: bool = False
    ) -> None:
        super().__init__(params, lr, weight_decay, adjust_lr_fn="match_rms_adamw")
        self._orthogonalize = orthogonalize_together if together else orthogonalize_each

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Update the weights by their gradients; `closure` is not called."""
        for group in self.param_groups:
            weights = [weight for weight in group["params"] if weight.grad is not None]
            directions = (self._direction(weight, group["momentum"]) for weight in weights)
            iteration = (group["ns_coefficients"], group["ns_steps"], group["eps"])
            changes = self._orthogonalize(directions, *iteration)
            for weight, change in zip(weights, changes, strict=True):
                _move(weight, change, group["lr"], group["weight_decay"])

    def _direction(self, weight: Tensor, momentum: float) -> Tensor:
        """The gradient (F, C) of `weight` with Nesterov's momentum; updates the momentum."""
        assert weight.grad is not None
        state = self.state[weight]
        if "momentum_buffer" not in state:
            state["momentum_buffer"] = torch.zeros_like(weight.grad)
        mean = state["momentum_buffer"]
        mean.lerp_(weight.grad, 1 - momentum)
        direction: Tensor = weight.grad.lerp(mean, momentum)
        return direction


def _move(weight: Tensor, change: Tensor, rate: float | Tensor, decay: float) -> None:
    """Decay `weight` (F, C) and subtract `change` (F, C) times the step length.

    `rate`: the learning rate, a number or a tensor (). `decay`: the weight decay.
    """
    length = rate * RMS_OF_ADAMW * max(weight.shape) ** 0.5
    weight.mul_(1 - rate * decay)
    if isinstance(length, Tensor):
        weight.sub_(change * length)
    else:
        weight.add_(change, alpha=-length)


Coefficients = tuple[float, float, float]


def orthogonalize_each(
    matrices: Iterable[Tensor], coefficients: Coefficients, steps: int, min_norm: float
) -> Iterator[Tensor]:
    """Yields each matrix (F, C) with its singular values brought near 1, one matrix at a time to
    save memory. `coefficients`, `steps` and `min_norm`: the iteration's polynomial, number of
    iterations and least divisor, as in `orthogonalize`."""
    return (orthogonalize(matrix, coefficients, steps, min_norm) for matrix in matrices)


def orthogonalize_together(
    matrices: Iterable[Tensor], coefficients: Coefficients, steps: int, min_norm: float
) -> list[Tensor]:
    """Return all matrices (F, C) with their singular values brought near 1. The Gram matrices
    (K, K) of N matrices whose shorter side has the same size K are processed as one batch
    (N, K, K).

    `coefficients`, `steps` and `min_norm`: the iteration's polynomial, number of iterations and
    least divisor, as in `orthogonalize`.
    """
    all_of = list(matrices)
    wide = [_wide(matrix, min_norm) for matrix in all_of]
    of_size: dict[int, list[int]] = {}
    for number, matrix in enumerate(wide):
        of_size.setdefault(len(matrix), []).append(number)
    found: dict[int, Tensor] = {}
    for numbers in of_size.values():
        grams = torch.stack([wide[n] @ wide[n].T for n in numbers])
        products = gram_polynomial(grams, coefficients, steps).unbind()
        found |= {n: product @ wide[n] for n, product in zip(numbers, products, strict=True)}
    return [_as_before(found[n], matrix) for n, matrix in enumerate(all_of)]


def orthogonalize(
    matrix: Tensor, coefficients: Coefficients, steps: int, min_norm: float
) -> Tensor:
    """Return `matrix` (F, C) with its singular values brought near 1.

    Takes `steps` Newton-Schulz iterations with the quintic polynomial of the three `coefficients`
    (Jordan et al. 2024). The matrix is first divided by its norm, or by `min_norm` if that is
    larger.
    """
    wide = _wide(matrix, min_norm)
    return _as_before(gram_polynomial(wide @ wide.T, coefficients, steps) @ wide, matrix)


def gram_polynomial(gram: Tensor, coefficients: Coefficients, steps: int) -> Tensor:
    """Compute the matrix by which `steps` Newton-Schulz iterations multiply a matrix whose Gram
    matrix is `gram`. The result is a polynomial of `gram`; both have the shape (K, K), or (N, K, K)
    for N matrices."""
    first, second, third = coefficients
    add_product = torch.addmm if gram.ndim == 2 else torch.baddbmm
    product: Tensor | None = None
    for left in reversed(range(steps)):
        factor = add_product(gram, gram, gram, beta=second, alpha=third)
        factor.diagonal(dim1=-2, dim2=-1).add_(first)
        # Polynomials of the same matrix commute.
        product = factor if product is None else factor @ product
        if left:
            gram = factor @ gram @ factor
    assert product is not None
    return product


def _wide(matrix: Tensor, min_norm: float) -> Tensor:
    """The matrix divided by its norm (at least `min_norm`), transposed if needed so that its
    shorter side comes first."""
    wide = matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T
    unit: Tensor = wide / wide.norm().clamp(min=min_norm)
    return unit


def _as_before(wide: Tensor, matrix: Tensor) -> Tensor:
    """`wide`, transposed if needed to the shape of `matrix`."""
    return wide if matrix.shape[0] <= matrix.shape[1] else wide.T
