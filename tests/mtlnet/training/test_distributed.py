"""Two processes train like one."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from mtlnet.architecture import find_architecture
from mtlnet.inference.curves import read_curves
from mtlnet.inference.model_card import WEIGHTS
from mtlnet.train import train
from mtlnet.training.config import TrainConfig
from mtlnet.training.distributed import (
    SINGLE_PROCESS,
    Rank,
    dropout_seed,
    process_group,
    read_rank,
)
from mtlnet.training.recipes import RECIPES
from mtlnet.training.trainer import Trainer
from trackfeatures.errors import UserError

TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
COMMAND = [*TORCHRUN, "-m", "mtlnet", "train"]


@pytest.mark.slow
@pytest.mark.extended
def test_two_processes_take_the_steps_of_one(dataset: Path, tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    given = {"recipe": "paper", "iterations": 10, "batch": 8, "seed": 3, "threads": 1}
    train(TrainConfig(dataset, one, device="cpu", **given), None)  # type: ignore[arg-type]
    options = ["--data", dataset, "--out", two, "--device", "cpu", "--json"]
    options += [word for name, value in given.items() for word in (f"--{name}", value)]
    done = subprocess.run([*COMMAND, *map(str, options)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count('"model_hash"') == 1  # only the first one prints
    (first,), (second,) = (read_curves(run / "curves.csv") for run in (one, two))
    for name in ("distance_loss", "angle_loss", "type_loss", "total_loss"):
        assert second[name] == pytest.approx(first[name], rel=0.01)
    a, b = load_file(one / WEIGHTS), load_file(two / WEIGHTS)
    for name in a:
        # bf16 sums in another order; the paper's step is small.
        np.testing.assert_allclose(b[name], a[name], atol=2e-4, err_msg=name)


def test_the_rank_is_read_from_the_environment_of_torchrun(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    assert read_rank() == SINGLE_PROCESS
    assert SINGLE_PROCESS.is_first
    for name, value in [("RANK", "3"), ("WORLD_SIZE", "4"), ("LOCAL_RANK", "1")]:
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    assert read_rank() == Rank(3, 4, 1, 2)
    assert not read_rank().is_first


def test_a_batch_that_does_not_divide_among_the_processes_is_refused() -> None:
    with (
        pytest.raises(UserError, match="--batch 32 cannot be divided among 3 processes"),
        process_group(Rank(0, 3), torch.device("cpu"), 32),
    ):
        pass


def masks(rank: int, step: int = 0) -> torch.Tensor:
    """Dropout masks that torch draws in a process."""
    torch.manual_seed(dropout_seed(7, rank, step))
    return torch.nn.functional.dropout(torch.ones(64), 0.5)


def test_every_process_draws_other_dropout_masks() -> None:
    drawn = [masks(rank, step) for rank in range(4) for step in (0, 60)]
    for i, one in enumerate(drawn):
        assert not any(torch.equal(one, other) for other in drawn[:i])
    assert torch.equal(masks(2, 60), masks(2, 60))


def test_the_first_process_of_a_new_run_draws_masks_from_the_seed_of_the_run() -> None:
    assert dropout_seed(7, rank=0) == 7


def test_the_trainer_seeds_torch_by_its_rank() -> None:
    states = []
    for index in range(2):
        plan = find_architecture("deepdriving")
        thin = replace(plan, shared=(8, 8))
        trainer = Trainer(
            RECIPES["paper"],
            (1.0, 1.0, 0.0),
            3,
            torch.device("cpu"),
            thin,
            rank=Rank(index, 2),
        )
        states.append(torch.get_rng_state())
        trainer.step_number = 5
        trainer.seed_dropout()
        states.append(torch.get_rng_state())
    for i, state in enumerate(states):
        assert not any(torch.equal(state, other) for other in states[:i])
