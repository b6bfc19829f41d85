"""Every weight is changed by one optimiser; Muon makes the directions of a step equal."""

from dataclasses import replace

import pytest
import torch

from mtlnet.model.network import Network, initialise
from mtlnet.training.optimizers import MUON_RATE, MUON_SIDE, GramMuon, Optimisers, as_rows, has_muon
from mtlnet.training.recipes import RECIPES, Recipe


def made(recipe: Recipe) -> tuple[Network, Optimisers]:
    network = Network(batch_norm=recipe.batch_norm, dropout=recipe.dropout)
    initialise(network, 1)
    network.to(memory_format=torch.channels_last)
    return network, Optimisers(network, recipe, [])


@pytest.mark.parametrize("name", RECIPES)
def test_each_weight_belongs_to_one_optimiser(name: str) -> None:
    network, optimisers = made(RECIPES[name])
    addresses = [
        parameter.data_ptr()
        for part in optimisers.parts
        for group in part.param_groups
        for parameter in group["params"]
    ]
    assert sorted(addresses) == sorted(p.data_ptr() for p in network.parameters())


def test_muon_has_the_convolutions_and_the_first_shared_layer() -> None:
    network, optimisers = made(RECIPES["fast"])
    names = {p.data_ptr(): name for name, p in network.named_parameters()}
    muon = {names[p.data_ptr()] for p in optimisers.parts[0].param_groups[0]["params"]}
    convolutions = {f"features.conv{number}.layer.weight" for number in (0, 2, 4, 5, 6)}
    assert muon == convolutions | {"shared.fc0.layer.weight"}


def test_layers_with_too_many_directions_are_left_to_adamw() -> None:
    """Network `deepdriving` would take twenty seconds a step for its 4096."""
    layer = "shared.fc0.layer.weight"
    at_most = torch.empty(MUON_SIDE, 4 * MUON_SIDE, device="meta")
    assert has_muon(layer, at_most)
    assert has_muon(layer, at_most.T)
    assert not has_muon(layer, torch.empty(MUON_SIDE + 1, 4 * MUON_SIDE, device="meta"))


def test_a_step_goes_equally_far_in_all_directions() -> None:
    network, optimisers = made(replace(RECIPES["fast"], l2=0.0))
    weight = network.get_parameter("features.conv5.layer.weight")
    generator = torch.Generator().manual_seed(0)
    left, _ = torch.linalg.qr(torch.randn(384, 384, generator=generator))
    right, _ = torch.linalg.qr(torch.randn(3456, 384, generator=generator))
    gradient = (left * torch.logspace(0, -2, 384)) @ right.T
    weight.grad = gradient.view(384, 3, 3, 384).permute(0, 3, 1, 2)
    before = as_rows(weight.detach()).clone()
    optimisers.set_rate(1e-3)
    optimisers.step()
    change = before - as_rows(weight.detach())
    lengths = torch.linalg.svdvals(change)
    # Newton and Schulz's five steps leave singular values between 0.5 and 1.5 (Jordan et al.).
    size = 1e-3 * MUON_RATE * 0.2 * 3456**0.5
    assert size * 0.4 < float(lengths.min())
    assert float(lengths.max()) < size * 1.6
    # Down the gradient in every one of its directions.
    assert bool(((left.T @ change @ right).diagonal() > 0).all())


@pytest.mark.parametrize("shape", [(96, 363), (384, 3456), (512, 64)])
def test_steps_are_those_of_torchs_muon(shape: tuple[int, int]) -> None:
    """Which rounds to bf16, to 8 bits, in each of its ten products."""
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(shape, generator=generator)
    ours, theirs = (torch.nn.Parameter(start.clone()) for _ in range(2))
    optimisers = (
        GramMuon([ours], 0.02, 0.1),
        torch.optim.Muon([theirs], 0.02, 0.1, adjust_lr_fn="match_rms_adamw"),
    )
    for _ in range(3):
        gradient = torch.randn(shape, generator=generator)
        for weight, optimiser in zip((ours, theirs), optimisers, strict=True):
            weight.grad = gradient.clone()
            optimiser.step()  # type: ignore[no-untyped-call]  # torch leaves it untyped
    change, expected = ours.detach() - start, theirs.detach() - start
    assert float((change - expected).norm() / expected.norm()) < 0.02
    for name, state in optimisers[1].state[theirs].items():
        torch.testing.assert_close(optimisers[0].state[ours][name], state)


def test_nothing_to_learn_changes_nothing() -> None:
    weight = torch.nn.Parameter(torch.ones(4, 8))
    weight.grad = torch.zeros(4, 8)
    GramMuon([weight], 0.02, 0.0).step()
    torch.testing.assert_close(weight.detach(), torch.ones(4, 8))


def test_the_rate_is_the_recipes_for_adamw_and_times_muons_for_muon() -> None:
    _, optimisers = made(RECIPES["fast"])
    optimisers.set_rate(4e-4)
    rates = [group["lr"] for part in optimisers.parts for group in part.param_groups]
    assert rates == [4e-4 * MUON_RATE, 4e-4, 4e-4]
    assert optimisers.rate == 4e-4
