"""All networks: folding, exported graphs, training; layers of those other than the paper's."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.recording import Dataset
from mtlnet.architecture import ARCHITECTURES, Architecture, find_architecture, with_heads
from mtlnet.data.loader import Loader
from mtlnet.data.road_ahead import RoadAhead
from mtlnet.inference.engine import EngineKind, load_engine, openvino_core
from mtlnet.inference.model_card import read_card
from mtlnet.model.auxiliary import LABELS
from mtlnet.model.network import Network, fold, initialise, predict_images
from mtlnet.model.openvino_graph import TOLERANCE, build_graph
from mtlnet.model.served import ServedNetwork
from mtlnet.train import start_training
from mtlnet.training.config import TrainConfig
from mtlnet.training.configure import new_config, resume_config
from mtlnet.training.recipes import RECIPES
from mtlnet.training.trainer import Trainer
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

BACKBONES = ["mobilenet_v3_small", "regnet_y_400mf"]
KINDS: tuple[EngineKind, EngineKind] = ("openvino", "torch")
OTHERS = [*BACKBONES, "deepdriving", "grid", "grid_residual", "grid-coded", "mtl-bins"]


def build(name: str, *, batch_norm: bool = False, dropout: float = 0.0, seed: int = 1) -> Network:
    network = Network(architecture=thin(name), batch_norm=batch_norm, dropout=dropout)
    initialise(network, seed)
    with torch.no_grad():  # heads as large as trained ones, so that outputs depend on the features
        network.get_parameter("heads.distance.weight").mul_(10)
    return network.eval()


def thin(name: str) -> Architecture:
    """The architecture with fewer units in its fully connected layers, to save time."""
    full = find_architecture(name)
    return replace(full, shared=(*[64] * (len(full.shared) - 1), 256))


def images(count: int, seed: int = 0) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.random.default_rng(seed).integers(0, 256, (count, 210, 280, 3), dtype=np.uint8)


def test_deepdriving_is_alexnet_with_a_fourth_layer() -> None:
    # Filters, inputs of one group and kernel of Caffe's AlexNet; 280 x 210 ends as 8 x 6.
    convolutions = [(96, 3, 11), (256, 48, 5), (384, 256, 3), (384, 192, 3), (256, 192, 3)]
    linears = [(256 * 8 * 6, 4096), (4096, 4096), (4096, 256), (256, 9)]
    expected = sum(o * i * k * k + o for o, i, k in convolutions)
    expected += sum(i * o + o for i, o in linears)
    assert expected == 70_502_281
    network = Network(architecture=find_architecture("deepdriving"))
    assert sum(p.numel() for p in network.parameters()) == expected
    sizes: list[tuple[int, ...]] = []
    for module in network.features.children():
        if isinstance(module, torch.nn.MaxPool2d):
            module.register_forward_hook(lambda _m, _i, out: sizes.append(tuple(out.shape[2:])))
    network(torch.from_numpy(images(1)))
    assert sizes == [(25, 34), (12, 17), (6, 8)]


def test_deepdriving_gives_equal_class_probabilities() -> None:
    answers = predict_images(build("deepdriving"), images(2))
    np.testing.assert_allclose(answers[:, 6:], 1 / 3, atol=1e-6)
    with pytest.raises(UserError, match="deepdriving has no class"):
        TrainConfig(Path("data"), Path("out"), network="deepdriving")
    with pytest.raises(UserError, match="no network 'vgg'; choose one of mtl, deepdriving"):
        TrainConfig(Path("data"), Path("out"), network="vgg")


@pytest.mark.parametrize("name", ["mtl", *BACKBONES])
def test_folding_keeps_the_outputs(name: str) -> None:
    network = build(name, batch_norm=True, dropout=0.1).train()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        network(torch.from_numpy(images(4)))  # updates the running statistics
        for module in network.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                module.weight.uniform_(0.5, 1.5, generator=generator)
                module.bias.uniform_(-0.2, 0.2, generator=generator)
    network.target_mean.copy_(torch.linspace(0.2, 0.7, 6))
    network.target_std.copy_(torch.linspace(0.02, 0.3, 6))
    folded = fold(network)
    assert not [m for m in folded.modules() if isinstance(m, torch.nn.BatchNorm2d)]
    before, after = (predict_images(n, images(2, seed=9)) for n in (network, folded))
    assert np.ptp(before[:, :6], axis=0).max() > 2e-4
    np.testing.assert_allclose(before, after, atol=2e-5)


@pytest.mark.parametrize("name", OTHERS)
def test_the_openvino_graph_matches_torch(name: str) -> None:
    network = fold(build(name))
    options = {"INFERENCE_PRECISION_HINT": "f32"}
    request = openvino_core().compile_model(build_graph(network), "CPU", options)
    frames = images(2, seed=3)
    expected = ServedNetwork(network)(torch.from_numpy(frames)).detach().numpy()
    found = np.concatenate([request(frame[None])[0] for frame in frames])
    assert np.ptp(expected[:, :5], axis=0).max() > 10 * TOLERANCE
    np.testing.assert_allclose(found, expected, atol=TOLERANCE)
    several = openvino_core().compile_model(build_graph(network, batch=-1), "CPU", options)
    np.testing.assert_allclose(several(frames)[0], expected, atol=TOLERANCE)


@pytest.mark.parametrize(
    ("name", "steps"),
    [
        ("mobilenet_v3_small", 12),
        pytest.param("deepdriving", 12, marks=pytest.mark.extended),
        ("grid", 40),
    ],
)
def test_other_networks_overfit_a_batch(dataset: Path, name: str, steps: int) -> None:
    architecture = thin(name)
    frames, camera = Dataset.open(dataset).select("train"), CameraParameters()
    ahead = RoadAhead(frames, camera) if architecture.bins else None
    loader = Loader(frames, camera, 4, 0, augment=False, ahead=ahead)
    recipe = replace(RECIPES["fast"], augment=False)
    trainer = Trainer(recipe, architecture.default_alpha, 0, torch.device("cpu"), architecture)
    trainer.standardise(loader)
    batch = loader.make(0)
    assert batch.ahead.shape == (4, LABELS if architecture.bins else 0)
    losses = [trainer.step(batch, 0.05) for _ in range(steps)]
    assert losses[-1].total.item() < 0.5 * losses[0].total.item()
    assert losses[-1].distance.item() < 0.3 * losses[0].distance.item()


@pytest.mark.usefixtures("short_fit")
def test_another_network_is_trained_published_and_run(dataset: Path, tmp_path: Path) -> None:
    options = {"data": dataset, "network": "mobilenet_v3_small", "iterations": 2, "batch": 4}
    result = start_training({**options, "device": "cpu"}, tmp_path / "run", resume=False)
    card = read_card(tmp_path / "run")
    assert (card.network, card.iterations) == ("mobilenet_v3_small", 2)
    assert result["export_check"]["openvino_f32_max"] < TOLERANCE
    frame = Dataset.open(dataset).select("test").image(0)
    engine, reference = (load_engine(tmp_path / "run", kind, "f32") for kind in KINDS)
    np.testing.assert_allclose(engine(frame), reference(frame), atol=TOLERANCE)


def test_a_network_has_a_variant_with_the_other_kind_of_heads() -> None:
    for name, architecture in ARCHITECTURES.items():
        kind, other = ("bins", "coded") if architecture.bins else ("coded", "bins")
        assert with_heads(name, kind) == name
        variant = find_architecture(with_heads(name, other))
        assert (variant.bins, variant.features) == (not architecture.bins, architecture.features)
        assert with_heads(variant.name, kind) == name
    with pytest.raises(UserError, match="--heads 'angle' is unknown; give coded or bins"):
        with_heads("mtl", "angle")


@pytest.mark.usefixtures("short_fit")
def test_the_heads_are_chosen_by_an_option(dataset: Path, tmp_path: Path) -> None:
    options = {"data": dataset, "network": "mtl", "iterations": 2, "batch": 4, "device": "cpu"}
    result = start_training({**options, "heads": "bins"}, tmp_path / "run", resume=False)
    assert read_card(tmp_path / "run").network == "mtl-bins"
    assert result["export_check"]["openvino_f32_max"] < TOLERANCE
    resumed, _ = resume_config(tmp_path / "run", {"network": "mtl", "heads": "bins"})
    assert resumed.network == "mtl-bins"
    with pytest.raises(UserError, match="started with network mtl-bins, now mtl is given"):
        resume_config(tmp_path / "run", {"heads": "coded"})
    with pytest.raises(UserError, match="keeps its heads"):
        new_config({"init": str(tmp_path / "run"), "heads": "coded"}, tmp_path / "tuned")


def test_the_seed_determines_a_backbones_weights() -> None:
    first, second, other = (build("mobilenet_v3_small", seed=s) for s in (1, 1, 2))
    a, b, c = (predict_images(n, images(1)) for n in (first, second, other))
    assert a.tolist() == b.tolist() != c.tolist()
