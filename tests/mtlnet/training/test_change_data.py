"""A run that continues on other data keeps the units in which its heads and its loss were trained,
and the history of its data."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from datagen.recording import Dataset
from datagen.recording.splits import Split, split_path, write_split
from mtlnet.architecture import MTL
from mtlnet.data.gpu_cache import DeviceBatch
from mtlnet.inference.model_card import ModelError
from mtlnet.training.checkpoint import load_checkpoint, save_checkpoint
from mtlnet.training.config import TrainConfig
from mtlnet.training.recipes import RECIPES
from mtlnet.training.sources import recorded_training_data, resume_data
from mtlnet.training.trainer import Trainer
from tests.mtlnet.conftest import write_dataset
from tests.mtlnet.training.test_captured_step import thin


def trainer_for(recipe: str, seed: int, std: float) -> Trainer:
    """A trainer, standardised on coded targets with the mean `seed` / 10 and the deviation
    `std`."""
    made = RECIPES[recipe]
    folded = not made.batch_norm
    trainer = Trainer(made, (1, 1, 1), seed, torch.device("cpu"), thin(MTL), folded=folded)
    loader: Any = SimpleNamespace(coded=np.full((4, 6), seed / 10) + [[std], [-std]] * 2)
    trainer.standardise(loader)
    return trainer


@pytest.mark.parametrize("recipe", ["fast", "tune"])
def test_other_data_does_not_change_the_loss_of_a_batch(recipe: str, tmp_path: Path) -> None:
    """The recipe `tune` trains a network without batch normalisation, whose file has no units."""
    first, second = trainer_for(recipe, 5, 0.2), trainer_for(recipe, 3, 0.02)
    rng = np.random.default_rng(1)
    batch = DeviceBatch(
        torch.from_numpy(rng.integers(0, 255, (4, 210, 280, 3), np.uint8)),
        torch.from_numpy(rng.uniform(0.1, 0.9, (4, 6)).astype(np.float32)),
        torch.tensor([0, 1, 2, 1]),
        torch.empty(4, 0),
    )
    load_checkpoint(save_checkpoint(tmp_path, first, 0.0), second)
    expected, found = (trainer.losses(batch) for trainer in (first, second))
    assert found.row().tolist() == expected.row().tolist()
    assert found.terms.tolist() == expected.terms.tolist()
    assert second.network.target_std.tolist() == pytest.approx([0.2] * 6)


def test_a_run_continues_on_another_split_of_its_rounds_if_told_to(tmp_path: Path) -> None:
    data = write_dataset(tmp_path)  # r003, of seed 3, is its test round
    config = TrainConfig(data, tmp_path / "run")
    earlier = recorded_training_data(Dataset.open(data)).about
    write_split(split_path(data), Split(("r001", "r002", "r003"), ("r000",)))
    changed = recorded_training_data(Dataset.open(data))
    with pytest.raises(ModelError, match=r"split of .* add --change-data"):
        resume_data(config, changed, earlier)
    about = resume_data(replace(config, change_data=True), changed, earlier).about
    assert about["seeds"] == {"count": 4, "ranges": "0..3"}
    assert [one["content_hash"] for one in about["earlier"]] == [earlier["content_hash"]]
    resume_data(config, changed, about)  # the next start
