"""A network that trains with batch normalisation starts with the outputs of a finished model."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import nn

from mtlnet.architecture import GRID, GRID_RESIDUAL, MTL, find_architecture
from mtlnet.inference.model_card import WEIGHTS
from mtlnet.model.network import Network, initialise, predict_images
from mtlnet.model.pretrained import NEW_SCALE, load_pretrained, match_convolutions
from trackfeatures.errors import UserError


def images(count: int, seed: int) -> NDArray[np.uint8]:
    coarse = np.random.default_rng(seed).integers(0, 256, (count, 21, 28, 3), dtype=np.uint8)
    return coarse.repeat(10, 1).repeat(10, 2)


@pytest.fixture(params=["grid", "mtl"])
def model(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A run folder with the weights of a network whose biases are not 0."""
    network = Network(architecture=find_architecture(request.param))
    initialise(network, 3)
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if name.endswith("bias"):
                parameter.normal_(0.0, 0.2, generator=generator)
    run = tmp_path / str(request.param)
    run.mkdir()
    save_file(network.state_dict(), run / WEIGHTS)
    return run


def started(model: Path, name: str, *, other: str = "") -> Network:
    network = Network(architecture=find_architecture(name), batch_norm=True)
    initialise(network, 5)
    load_pretrained(network, model / WEIGHTS, images(8, 0), other)
    return network


def loaded(model: Path) -> Network:
    network = Network(architecture=find_architecture(model.name))
    load_pretrained(network, model / WEIGHTS)
    return network


def test_batch_normalisation_is_put_back_without_a_change_of_the_outputs(model: Path) -> None:
    network = started(model, model.name)
    assert any(isinstance(m, nn.BatchNorm2d) for m in network.modules())
    for seed in (0, 7):  # the images that the statistics come from, and others
        expected = predict_images(loaded(model), images(4, seed))
        np.testing.assert_allclose(predict_images(network, images(4, seed)), expected, atol=1e-4)


def test_filters_have_the_size_of_new_ones(model: Path) -> None:
    network = started(model, model.name)
    weight = network.get_parameter("features.conv0.layer.weight").flatten(1)
    np.testing.assert_allclose(weight.square().mean(1).detach(), 2 / weight.shape[1], rtol=1e-5)


def test_in_training_its_outputs_are_those_of_the_model_on_the_same_images(model: Path) -> None:
    network = started(model, model.name).train()
    network.auxiliary = None
    with torch.no_grad():
        found = network(torch.from_numpy(images(8, 0)))[:, :6].numpy()
    expected = predict_images(loaded(model), images(8, 0))[:, :6]
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_new_residual_convolutions_change_little_and_learn(tmp_path: Path) -> None:
    network = Network(architecture=GRID)
    initialise(network, 3)
    save_file(network.state_dict(), tmp_path / WEIGHTS)
    grown = started(tmp_path, "grid_residual", other="grid")
    frames = torch.from_numpy(images(8, 0))
    with torch.no_grad():
        before = network.eval().forward_features(frames)
        after = grown.forward_features(frames)
    assert 0 < float((after - before).norm() / before.norm()) < 10 * NEW_SCALE
    grown.train()
    grown.forward_features(frames).sum().backward()  # type: ignore[no-untyped-call]
    old = set(match_convolutions(GRID, GRID_RESIDUAL).values())
    new = [name for name in GRID_RESIDUAL.convolutions if name not in old]
    assert len(new) == 6
    for name in new:
        gradient = grown.get_parameter(f"features.{name}.layer.weight").grad
        assert gradient is not None
        assert float(gradient.abs().max()) > 0


def test_matching_convolutions() -> None:
    assert match_convolutions(GRID, GRID) == {f"conv{i}": f"conv{i}" for i in range(5)}
    found = match_convolutions(GRID, GRID_RESIDUAL)
    assert list(found.values()) == ["conv0", "conv1", "conv4", "conv5", "conv10"]
    for old, new in [(MTL, GRID), (GRID_RESIDUAL, GRID), (GRID, replace(GRID, shared=(256,)))]:
        with pytest.raises(UserError, match="cannot start"):
            match_convolutions(old, new)
