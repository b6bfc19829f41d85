"""Every weight has one optimizer; Muon makes the singular values of a step equal."""

from dataclasses import replace

import pytest
import torch

from mtlnet.model.network import Network, initialise
from mtlnet.training.optimizers import (
    MUON_LR_SCALE,
    MUON_MAX_SIDE,
    GramMuon,
    OptimizerSet,
    as_matrix,
    orthogonalize_each,
    orthogonalize_together,
    uses_muon,
)
from mtlnet.training.recipes import RECIPES, Recipe


def build(recipe: Recipe) -> tuple[Network, OptimizerSet]:
    network = Network(batch_norm=recipe.batch_norm, dropout=recipe.dropout)
    initialise(network, 1)
    network.to(memory_format=torch.channels_last)
    return network, OptimizerSet(network, recipe, [])


@pytest.mark.parametrize("name", RECIPES)
def test_each_weight_belongs_to_one_optimizer(name: str) -> None:
    network, optimizers = build(RECIPES[name])
    addresses = [
        parameter.data_ptr()
        for part in optimizers.optimizers
        for group in part.param_groups
        for parameter in group["params"]
    ]
    assert sorted(addresses) == sorted(p.data_ptr() for p in network.parameters())


def test_muon_trains_the_convolutions_and_the_first_shared_layer() -> None:
    network, optimizers = build(RECIPES["fast"])
    names = {p.data_ptr(): name for name, p in network.named_parameters()}
    muon = {names[p.data_ptr()] for p in optimizers.optimizers[0].param_groups[0]["params"]}
    convolutions = {f"features.conv{number}.layer.weight" for number in (0, 2, 4, 5, 6)}
    assert muon == convolutions | {"shared.fc0.layer.weight"}


def test_adamw_trains_layers_that_are_too_large_for_muon() -> None:
    """With the 4096 rows of network `deepdriving` Muon would take twenty seconds per step."""
    layer = "shared.fc0.layer.weight"
    at_most = torch.empty(MUON_MAX_SIDE, 4 * MUON_MAX_SIDE, device="meta")
    assert uses_muon(layer, at_most)
    assert uses_muon(layer, at_most.T)
    assert not uses_muon(layer, torch.empty(MUON_MAX_SIDE + 1, 4 * MUON_MAX_SIDE, device="meta"))


def test_the_singular_values_of_a_muon_step_are_nearly_equal() -> None:
    network, optimizers = build(replace(RECIPES["fast"], l2=0.0))
    weight = network.get_parameter("features.conv5.layer.weight")
    generator = torch.Generator().manual_seed(0)
    left, _ = torch.linalg.qr(torch.randn(384, 384, generator=generator))
    right, _ = torch.linalg.qr(torch.randn(3456, 384, generator=generator))
    gradient = (left * torch.logspace(0, -2, 384)) @ right.T
    weight.grad = gradient.view(384, 3, 3, 384).permute(0, 3, 1, 2)
    before = as_matrix(weight.detach()).clone()
    optimizers.set_learning_rate(1e-3)
    optimizers.step()
    change = before - as_matrix(weight.detach())
    lengths = torch.linalg.svdvals(change)
    # Five Newton-Schulz iterations leave singular values between 0.5 and 1.5 (Jordan et al.).
    size = 1e-3 * MUON_LR_SCALE * 0.2 * 3456**0.5
    assert size * 0.4 < float(lengths.min())
    assert float(lengths.max()) < size * 1.6
    # Down the gradient in every one of its directions.
    assert bool(((left.T @ change @ right).diagonal() > 0).all())


@pytest.mark.parametrize(
    "shape", [(96, 363), pytest.param((384, 3456), marks=pytest.mark.extended), (512, 64)]
)
def test_steps_equal_those_of_torchs_muon(shape: tuple[int, int]) -> None:
    """Equal within the precision of torch, which rounds each of ten products to bf16 (8 bits)."""
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(shape, generator=generator)
    ours, theirs = (torch.nn.Parameter(start.clone()) for _ in range(2))
    optimizers = (
        GramMuon([ours], 0.02, 0.1),
        torch.optim.Muon([theirs], 0.02, 0.1, adjust_lr_fn="match_rms_adamw"),
    )
    for _ in range(3):
        gradient = torch.randn(shape, generator=generator)
        for weight, optimizer in zip((ours, theirs), optimizers, strict=True):
            weight.grad = gradient.clone()
            optimizer.step()  # type: ignore[no-untyped-call]  # torch leaves it untyped
    change, expected = ours.detach() - start, theirs.detach() - start
    assert float((change - expected).norm() / expected.norm()) < 0.02
    for name, state in optimizers[1].state[theirs].items():
        torch.testing.assert_close(optimizers[0].state[ours][name], state)


def test_muon_iterates_on_layers_together_as_on_each() -> None:
    """Numbers for which every product and sum is exact in float32, on any processor."""
    generator = torch.Generator().manual_seed(0)

    def signs(*shape: int) -> torch.Tensor:
        return torch.randint(0, 2, shape, generator=generator) * 2.0 - 1.0

    # Each with 4^k entries of +-1, so that its norm is a power of two.
    matrices = [signs(8, 8), signs(4, 16), signs(32, 8), signs(8, 32), signs(4, 4)]
    exact = (2.0, -1.0, 0.5)
    each = list(orthogonalize_each(matrices, exact, 1, 1e-7))
    together = orthogonalize_together(matrices, exact, 1, 1e-7)
    for matrix, one, other in zip(matrices, each, together, strict=True):
        assert one.shape == matrix.shape
        assert torch.equal(one, other)
    # By hand: with G = X X^T the result is (2 - G + G^2 / 2) X.
    x = matrices[1] / 8
    gram = x @ x.T
    assert torch.equal(together[1], (2 * torch.eye(4) - gram + gram @ gram / 2) @ x)


def test_muon_of_layers_together_takes_the_steps_of_each() -> None:
    generator = torch.Generator().manual_seed(0)
    starts = [torch.randn(s, generator=generator) for s in ((16, 64), (64, 16), (16, 40), (8, 9))]
    ends = []
    for together in (False, True):
        draw = torch.Generator().manual_seed(1)
        weights = [torch.nn.Parameter(start.clone()) for start in starts]
        optimizer = GramMuon(weights, 0.02, 0.1, together=together)
        for number in range(3):
            for weight in weights:
                weight.grad = torch.randn(weight.shape, generator=draw)
            weights[number].grad = None  # as of a frozen layer
            optimizer.step()
        ends.append(weights)
    for one, other in zip(*ends, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


def test_a_gradient_of_zero_changes_nothing() -> None:
    weight = torch.nn.Parameter(torch.ones(4, 8))
    weight.grad = torch.zeros(4, 8)
    GramMuon([weight], 0.02, 0.0).step()
    torch.testing.assert_close(weight.detach(), torch.ones(4, 8))


def test_the_learning_rate_of_muon_is_scaled() -> None:
    _, optimizers = build(RECIPES["fast"])
    optimizers.set_learning_rate(4e-4)
    rates = [group["lr"] for part in optimizers.optimizers for group in part.param_groups]
    assert rates == [4e-4 * MUON_LR_SCALE, 4e-4, 4e-4]
    assert optimizers.learning_rate == 4e-4
