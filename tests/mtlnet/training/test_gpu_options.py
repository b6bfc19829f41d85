"""On a GPU batches are larger and rates are scaled; a run keeps them on any device."""

import math
from pathlib import Path

import pytest
import torch

from datagen.recording import Dataset
from mtlnet.training.configure import new_config, resume_config, write_config
from mtlnet.training.distributed import SINGLE_PROCESS
from mtlnet.training.recipes import RECIPES, learning_rate_factor
from mtlnet.training.run import prepare
from mtlnet.training.sources import recorded_training_data
from tests.mtlnet.conftest import training_config


@pytest.mark.parametrize(
    ("recipe", "batch", "factor"),
    [("fast", 64, 1.0), ("fast", 256, 2.0), ("continue", 1024, 4.0), ("paper", 256, 8.0)],
)
def test_the_rate_grows_as_the_batch_or_its_root(recipe: str, batch: int, factor: float) -> None:
    assert learning_rate_factor(RECIPES[recipe], batch) == factor


@pytest.mark.parametrize(
    ("given", "batch", "factor"),
    [
        ({}, 256, 2.0),
        ({"batch": 512}, 512, math.sqrt(8)),
        ({"recipe": "paper"}, 32, 1.0),
        ({"recipe": "paper", "batch": 64}, 64, 2.0),
    ],
)
def test_a_new_run_on_a_gpu_has_its_batch_and_rate(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    given: dict[str, object],
    batch: int,
    factor: float,
) -> None:
    on_cpu = new_config({"device": "cpu", **given}, tmp_path)
    assert on_cpu.rate_factor == 1.0
    assert on_cpu.batch == given.get("batch", RECIPES[on_cpu.recipe].batch)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    config = new_config(given, tmp_path)  # by itself it chooses the GPU
    assert (config.batch, config.rate_factor) == (batch, factor)
    write_config(config, RECIPES[config.recipe], {})
    resumed, _ = resume_config(tmp_path, {"device": "cpu"})
    assert (resumed.batch, resumed.rate_factor) == (batch, factor)


@pytest.mark.usefixtures("small_network")
def test_a_run_trains_at_its_rate(dataset: Path, tmp_path: Path) -> None:
    config = training_config(dataset, tmp_path, rate_factor=2.0)
    data = recorded_training_data(Dataset.open(dataset))
    trainer, _ = prepare(config, data, None, torch.device("cpu"), SINGLE_PROCESS)
    assert trainer.recipe.learning_rate == 2 * RECIPES["fast"].learning_rate
