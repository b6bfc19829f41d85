"""A network with heads over bins learns, is published, and runs like any other."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.recording import Dataset
from mtlnet.architecture import GRID
from mtlnet.data.loader import Loader
from mtlnet.data.road_ahead import RoadAhead
from mtlnet.inference.engine import EngineKind, load_engine
from mtlnet.inference.model_card import read_card
from mtlnet.model.auxiliary import LABELS
from mtlnet.model.openvino_graph import TOLERANCE
from mtlnet.train import start_training
from mtlnet.training.recipes import RECIPES
from mtlnet.training.trainer import Trainer
from trackfeatures.camera import CameraParameters

KINDS: tuple[EngineKind, EngineKind] = ("openvino", "torch")
THIN = replace(GRID, shared=(64, 32, 32))


def test_one_batch_is_learned_by_heart(dataset: Path) -> None:
    frames = Dataset.open(dataset).select("train")
    ahead = RoadAhead(frames, CameraParameters())
    loader = Loader(frames, CameraParameters(), 8, 0, augment=False, ahead=ahead)
    trainer = Trainer(
        replace(RECIPES["fast"], augment=False), (0.3, 0.2, 0.5), 0, torch.device("cpu"), THIN
    )
    trainer.standardise(loader)
    batch = loader.make(0)
    assert batch.ahead.shape == (8, LABELS)
    losses = [trainer.step(batch, 0.05) for _ in range(40)]
    assert losses[-1].total.item() < 0.6 * losses[0].total.item()
    assert losses[-1].distance.item() < 0.3 * losses[0].distance.item()


@pytest.mark.usefixtures("short_fit")
def test_it_is_trained_published_and_run_like_any_other(dataset: Path, tmp_path: Path) -> None:
    options = {"data": dataset, "network": "grid", "iterations": 2, "batch": 4, "device": "cpu"}
    result = start_training(options, tmp_path / "run", resume=False)
    card = read_card(tmp_path / "run")
    assert (card.network, card.iterations) == ("grid", 2)
    assert result["export_check"]["openvino_f32_max"] < TOLERANCE
    frame = Dataset.open(dataset).select("test").image(0)
    fast, oracle = (load_engine(tmp_path / "run", kind, "f32") for kind in KINDS)
    np.testing.assert_allclose(fast(frame)[:9], oracle(frame)[:9], atol=TOLERANCE)
