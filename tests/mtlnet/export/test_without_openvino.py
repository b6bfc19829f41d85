"""Without OpenVINO a machine trains, ships and evaluates by torch; another machine serves the
result."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.gpu.publish_checkpoint import publish_checkpoint
from datagen.recording import Dataset
from mtlnet.architecture import HEIGHT, WIDTH, find_architecture
from mtlnet.data.description import describe_data
from mtlnet.evaluation.evaluate import evaluate
from mtlnet.export.publish import Provenance, export_text, publish
from mtlnet.export.ship import ship_model
from mtlnet.inference.engine import has_openvino, load_engine
from mtlnet.inference.golden_image import golden_image
from mtlnet.inference.model_card import (
    CARD,
    UNCERTAINTY_WEIGHTS,
    WEIGHTS,
    ModelError,
    read_card,
)
from mtlnet.inference.torch_engine import TorchEngine, read_uncertainty_head
from mtlnet.model.network import fold, load_network, predict_images
from mtlnet.model.openvino_graph import TOLERANCE
from mtlnet.model.uncertainty_head import FittedUncertainty
from mtlnet.training.checkpoint import save_checkpoint
from mtlnet.training.recipes import find_recipe
from mtlnet.training.run import create_run
from mtlnet.training.trainer import Trainer
from mtlnet.uncertainty_fit.frame_outputs import run_on_frames
from tests.mtlnet.conftest import training_config
from trackfeatures.errors import UserError


def test_what_torch_alone_publishes_and_ships_is_served(
    published: Path, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, out = tmp_path / "run", tmp_path / "shipped"
    before = read_card(published)
    network = load_network(published / WEIGHTS, before.network)
    assert before.uncertainty is not None
    fitted = FittedUncertainty(read_uncertainty_head(published), before.uncertainty)
    image = Dataset.open(dataset).select("test").image(0)
    with monkeypatch.context() as hidden:
        hidden.setitem(sys.modules, "openvino", None)
        assert not has_openvino()
        card = publish(network, run, image[None], Provenance(data=before.data), fitted)
        found = ship_model(run, out)
        report = evaluate([load_engine(out, "torch")], dataset, "test")
    assert set(card.files) == {WEIGHTS, UNCERTAINTY_WEIGHTS}
    assert card.export_check == {"frames": 0.0}
    assert export_text(card.export_check).startswith("weights alone")
    assert "16 frames" in export_text({"frames": 16.0, "openvino_f32_max": 1e-6})
    assert {path.name for path in run.iterdir()} == {*card.files, CARD}
    assert 0.0 < found["check"]["from_run_on_golden_image"] < 2e-2
    with monkeypatch.context() as hidden:
        hidden.setattr("mtlnet.inference.engine.find_spec", lambda _: None)
        with pytest.raises(ModelError, match=r"shipped has no graph .*`mtlnet ship --model"):
            load_engine(out, "openvino", "f32")
    for folder in (run, out):
        graph = load_engine(folder, "openvino", "f32")
        expected = load_engine(folder, "torch")(image)
        np.testing.assert_allclose(graph(image)[:9], expected[:9], atol=TOLERANCE)
    again = evaluate([load_engine(out, "openvino", "f32")], dataset, "test")
    assert (report["engine"], again["engine"]) == ("torch", "openvino")
    assert report["angle_mae_rad"] == pytest.approx(again["angle_mae_rad"], abs=1e-4)


@pytest.mark.usefixtures("small_network")
def test_a_training_that_was_stopped_is_published_from_its_checkpoint(
    dataset: Path, tmp_path: Path
) -> None:
    """Publishing by `benchmarks/gpu_run.py` when the minutes end before the training does."""
    config = training_config(dataset, tmp_path / "run")
    recipe, data = find_recipe("fast"), Dataset.open(dataset)
    about = describe_data(data, data.select("train"))
    trainer = Trainer(recipe, config.alpha, 3, torch.device("cpu"), find_architecture("grid"))
    trainer.step_number = 30
    create_run(config, recipe, about)
    with pytest.raises(UserError, match="has no checkpoint"):
        publish_checkpoint(config.out)
    save_checkpoint(config.out, trainer, 1.0)
    assert publish_checkpoint(config.out) == 30
    card = read_card(config.out)
    expected = predict_images(fold(trainer.network), golden_image(WIDTH, HEIGHT)[None])[0]
    assert card.golden == pytest.approx(expected, abs=1e-6)
    assert (card.iterations, card.batch, card.recipe) == (30, config.batch, "fast")
    assert (card.uncertainty, card.data["mean"]) == (None, about["mean"])


def test_the_uncertainty_head_is_fitted_on_the_same_numbers(
    published: Path, dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = load_engine(published, "torch")
    assert isinstance(engine, TorchEngine)
    frames = Dataset.open(dataset).select("train")
    by_openvino = run_on_frames(engine.served.network, frames, 40)
    monkeypatch.setitem(sys.modules, "openvino", None)
    by_torch = run_on_frames(engine.served.network, frames, 40)
    assert by_torch.x.shape == by_openvino.x.shape == (40, 256 + 10)
    # OpenVINO computes in bf16 where the processor has it: 8 bits.
    np.testing.assert_allclose(by_torch.x, by_openvino.x, rtol=0.05, atol=0.05)
    np.testing.assert_allclose(by_torch.error, by_openvino.error, atol=0.1)
    np.testing.assert_allclose(by_torch.texture, by_openvino.texture, rtol=1e-5, atol=1e-6)


def test_a_batch_is_answered_as_its_images_one_by_one(published: Path) -> None:
    engine = load_engine(published, "torch", gpu=True)
    assert isinstance(engine, TorchEngine)
    images = np.random.default_rng(0).integers(0, 256, (3, 210, 280, 3), np.uint8)
    found = engine.batch(images)
    assert found.shape == (3, 17)
    for row, image in zip(found, images, strict=True):
        np.testing.assert_allclose(row, engine(image), rtol=1e-4, atol=1e-6)


def test_on_a_gpu_frames_are_answered_in_batches(
    published: Path, dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = load_engine(published, "torch")
    assert isinstance(engine, TorchEngine)
    one_by_one = evaluate([engine], dataset, "test")
    sizes: list[int] = []

    def batch(images: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> object:
        sizes.append(len(images))
        return TorchEngine.batch(engine, images)

    monkeypatch.setattr(engine, "on_gpu", True)
    monkeypatch.setattr(engine, "batch", batch)
    batched = evaluate([engine], dataset, "test")
    assert sizes == [24]
    assert batched["angle_mae_rad"] == pytest.approx(one_by_one["angle_mae_rad"], abs=1e-6)
    assert read_card(published).model_hash == batched["model_hash"]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_answers_as_the_processor_does(
    published: Path, dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gpu, cpu = (load_engine(published, "torch", gpu=on_gpu) for on_gpu in (True, False))
    assert isinstance(gpu, TorchEngine)
    assert isinstance(cpu, TorchEngine)
    assert (gpu.on_gpu, cpu.on_gpu) == (True, False)
    frames = Dataset.open(dataset).select("test")
    images = frames.read_batch(np.arange(len(frames)))
    np.testing.assert_allclose(gpu.batch(images), cpu.batch(images), rtol=1e-3, atol=1e-4)
    monkeypatch.setitem(sys.modules, "openvino", None)
    by_gpu = run_on_frames(cpu.served.network, frames, 40)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    by_cpu = run_on_frames(cpu.served.network, frames, 40)
    np.testing.assert_allclose(by_gpu.x, by_cpu.x, rtol=1e-2, atol=1e-3)
    np.testing.assert_allclose(by_gpu.error, by_cpu.error, atol=1e-2)
