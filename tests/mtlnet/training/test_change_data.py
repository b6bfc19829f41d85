"""A run that continues on other data keeps the units in which its heads and its loss were
trained."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from mtlnet.architecture import MTL
from mtlnet.data.gpu_cache import DeviceBatch
from mtlnet.training.checkpoint import load_checkpoint, save_checkpoint
from mtlnet.training.recipes import RECIPES
from mtlnet.training.trainer import Trainer
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
