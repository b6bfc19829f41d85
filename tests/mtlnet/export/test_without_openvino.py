"""A machine without OpenVINO trains, ships and evaluates by torch; another serves the result."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.material.gpu.salvage import publish_checkpoint
from datagen.recording import Dataset
from mtlnet.evaluation.evaluate import evaluate
from mtlnet.export.openvino_graph import TOLERANCE
from mtlnet.export.ship import ship_model
from mtlnet.inference.engine import has_openvino, load_engine
from mtlnet.inference.model_card import CARD, UNCERTAINTY_WEIGHTS, WEIGHTS, read_card
from mtlnet.inference.torch_engine import TorchEngine
from mtlnet.training.run import train
from mtlnet.uncertainty_fit.head import run_on_frames
from tests.mtlnet.conftest import training_config


@pytest.mark.slow
@pytest.mark.usefixtures("small_network")
def test_what_torch_alone_trains_and_ships_is_served(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, out = tmp_path / "run", tmp_path / "shipped"
    with monkeypatch.context() as hidden:
        hidden.setitem(sys.modules, "openvino", None)
        assert not has_openvino()
        card = train(training_config(dataset, run), None)
        found = ship_model(run, out)
        report = evaluate([load_engine(out, "torch")], dataset, "test")
        # As after a training that was stopped: a checkpoint, and no card.
        stopped = shutil.copytree(run, tmp_path / "stopped")
        (stopped / CARD).unlink()
        assert publish_checkpoint(stopped) == card.iterations == 4
    saved = read_card(stopped)
    assert (saved.golden, saved.data, saved.uncertainty) == (card.golden, card.data, None)
    assert set(saved.files) == {WEIGHTS}
    assert set(card.files) == {WEIGHTS, UNCERTAINTY_WEIGHTS}
    assert card.export_check == {"frames": 0.0}
    assert not [*run.glob("model.xml"), *run.glob("model.bin")]
    assert 0.0 < found["check"]["from_run_on_golden_image"] < 2e-2
    image = Dataset.open(dataset).select("test").image(0)
    for folder in (run, out):
        graph = load_engine(folder, "openvino", "f32")
        expected = load_engine(folder, "torch")(image)
        np.testing.assert_allclose(graph(image)[:9], expected[:9], atol=TOLERANCE)
    again = evaluate([load_engine(out, "openvino", "f32")], dataset, "test")
    assert (report["engine"], again["engine"]) == ("torch", "openvino")
    assert report["angle_mae_rad"] == pytest.approx(again["angle_mae_rad"], abs=1e-4)


def test_the_uncertainty_head_is_fitted_on_the_same_numbers(
    published: Path, dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = load_engine(published, "torch")
    assert isinstance(engine, TorchEngine)
    frames = Dataset.open(dataset).select("train")
    by_openvino = run_on_frames(engine._network, frames, 40)
    monkeypatch.setitem(sys.modules, "openvino", None)
    by_torch = run_on_frames(engine._network, frames, 40)
    assert by_torch.x.shape == by_openvino.x.shape == (40, 256 + 10)
    # OpenVINO computes in bf16 where the processor has it: 8 bits.
    np.testing.assert_allclose(by_torch.x, by_openvino.x, rtol=0.05, atol=0.05)
    np.testing.assert_allclose(by_torch.error, by_openvino.error, atol=0.1)
    np.testing.assert_array_equal(by_torch.texture, by_openvino.texture)


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
