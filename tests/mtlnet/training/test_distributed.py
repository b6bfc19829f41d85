"""Two processes take the steps of one."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from mtlnet.inference.curves import read_curves
from mtlnet.inference.model_card import WEIGHTS
from mtlnet.training.config import TrainConfig
from mtlnet.training.distributed import ALONE, Part, find_part, joined
from mtlnet.training.run import train
from trackfeatures.errors import UserError

TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
COMMAND = [*TORCHRUN, "-m", "mtlnet", "train"]


@pytest.mark.slow
def test_two_processes_learn_what_one_does(dataset: Path, tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    given = {"recipe": "paper", "iterations": 10, "batch": 8, "seed": 3, "threads": 1}
    train(TrainConfig(dataset, one, device="cpu", **given), None)  # type: ignore[arg-type]
    options = ["--data", dataset, "--out", two, "--device", "cpu", "--json"]
    options += [word for name, value in given.items() for word in (f"--{name}", value)]
    done = subprocess.run([*COMMAND, *map(str, options)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count('"model_hash"') == 1  # only the first one speaks
    (first,), (second,) = (read_curves(run / "curves.csv") for run in (one, two))
    for name in ("distance_loss", "angle_loss", "type_loss", "total_loss"):
        assert second[name] == pytest.approx(first[name], rel=0.01)
    a, b = load_file(one / WEIGHTS), load_file(two / WEIGHTS)
    for name in a:
        # bf16 sums in another order; the paper's step is small.
        np.testing.assert_allclose(b[name], a[name], atol=2e-4, err_msg=name)


def test_alone_without_torchrun(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    assert find_part() == ALONE
    assert ALONE.first
    for name, value in [("RANK", "3"), ("WORLD_SIZE", "4"), ("LOCAL_RANK", "1")]:
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    assert find_part() == Part(3, 4, 1, 2)
    assert not find_part().first


def test_a_batch_that_does_not_divide_is_refused() -> None:
    with (
        pytest.raises(UserError, match="--batch 32 does not divide among 3 processes"),
        joined(Part(0, 3), torch.device("cpu"), 32),
    ):
        pass
