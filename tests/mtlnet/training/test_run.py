"""A training run: its steps, what it stores, and what it refuses."""

import json
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from datagen.recording import Dataset
from mtlnet.data.loader import Loader
from mtlnet.inference.curves import read_curves
from mtlnet.inference.model_card import GRAPH, UNCERTAINTY_WEIGHTS, WEIGHTS, read_card
from mtlnet.inference.trained_rounds import names_entry
from mtlnet.model.cpu_kernels.forward import training_outputs
from mtlnet.train import train
from mtlnet.training.checkpoint import list_checkpoints
from mtlnet.training.loop import TrainProgress
from mtlnet.training.recipes import RECIPES, learning_rate
from mtlnet.training.run import require_new
from mtlnet.training.trainer import Trainer
from tests.mtlnet.conftest import training_config
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

CPU = torch.device("cpu")

pytestmark = pytest.mark.usefixtures("short_fit")


def test_one_batch_is_overfitted(dataset: Path) -> None:
    frames = Dataset.open(dataset).select("train")
    loader = Loader(frames, CameraParameters(), 8, 0, augment=False)
    recipe = replace(RECIPES["fast"], augment=False, batch=8)
    trainer = Trainer(recipe, (0.3, 0.2, 0.5), 0, CPU)
    trainer.standardise(loader)
    batch = loader.make(0)
    first = trainer.step(batch, 0.05)
    for _ in range(30):
        last = trainer.step(batch, 0.05)
    # In units of the target variances predicting the mean costs about 0.3 + 0.2 + 0.5 ln 3.
    assert first.total.item() > 0.6
    assert last.total.item() < 0.05
    assert float(last.angle) < 0.1 * float(np.var(batch.coded[:, 5]))


def test_batch_norm_statistics_are_frozen_late_in_a_run(dataset: Path) -> None:
    frames = Dataset.open(dataset).select("train")
    recipe = replace(RECIPES["fast"], batch=4)
    trainer = Trainer(recipe, (0.3, 0.2, 0.5), 0, CPU)
    batch = Loader(frames, CameraParameters(), 4, 0, augment=False).make(0)
    mean = trainer.network.get_buffer("features.conv0.norm.running_mean")
    seen = [mean.clone()]
    late = recipe.freeze_bn_at
    for steps, progress in ((200, late - 0.1), (200, late), (200, 0.99), (5, 0.99)):
        trainer.step_number = steps
        trainer.step(batch, progress)
        seen.append(mean.clone())
    moved = [not torch.equal(a, b) for a, b in pairwise(seen)]
    # After few steps the statistics are not frozen yet.
    assert moved == [True, False, False, True]


def test_the_first_convolutions_are_frozen_after_a_part_of_the_run(dataset: Path) -> None:
    frames = Dataset.open(dataset).select("train")
    recipe = replace(RECIPES["fast"], batch=4)
    trainer = Trainer(recipe, (0.3, 0.2, 0.5), 0, CPU)
    batch = Loader(frames, CameraParameters(), 4, 0, augment=False).make(0)
    network = trainer.network
    assert [share for share, _ in recipe.freeze_schedule] == sorted(
        share for share, _ in recipe.freeze_schedule
    )
    for progress, count in [
        (0.1, 0),
        *recipe.freeze_schedule,
        (0.99, recipe.freeze_schedule[-1][1]),
    ]:
        before = {name: weight.detach().clone() for name, weight in network.named_parameters()}
        trainer.step(batch, progress)
        still = {
            n.split(".")[1] for n, w in network.named_parameters() if torch.equal(w, before[n])
        }
        assert still == set(network.architecture.convolutions[:count])


def test_a_full_gpu_is_reported_in_one_line(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB.\n...")

    monkeypatch.setattr("mtlnet.training.run.train_loop", full)
    with pytest.raises(UserError, match="memory of cpu is used up; give a smaller --batch than 4"):
        train(training_config(dataset, tmp_path / "run"), None)


def test_a_loss_that_is_not_finite_stops_the_run_at_its_batch(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mtlnet.training.loop.CHECKPOINT_SECONDS", 0.0)
    original = training_outputs
    calls: list[int] = []

    def outputs(*given: Any) -> torch.Tensor:
        calls.append(1)
        return original(*given) * (float("nan") if len(calls) == 3 else 1.0)

    monkeypatch.setattr("mtlnet.training.trainer.training_outputs", outputs)
    with pytest.raises(UserError, match="the loss of batch 3 is not a finite number") as caught:
        train(training_config(dataset, tmp_path / "run", network="mtl"), None)
    assert "\n" not in str(caught.value)
    (*_, last) = list_checkpoints(tmp_path / "run")
    assert last.name == "step-00000002.safetensors"
    assert all(np.isfinite(value).all() for value in load_file(last).values())


def test_a_run_stores_its_configuration_data_and_curves(dataset: Path, tmp_path: Path) -> None:
    points: list[TrainProgress] = []
    done = train(training_config(dataset, tmp_path / "run", iterations=10), None, points.append)
    run = tmp_path / "run"
    assert read_card(run) == done
    assert done.iterations == 10
    assert done.export_check["openvino_f32_max"] < 2e-4
    assert set(done.files) == {WEIGHTS, UNCERTAINTY_WEIGHTS, GRAPH, "model.bin"}
    assert done.data["content_hash"] == Dataset.open(dataset).content_hash
    assert done.data["split"]["test"] == names_entry(["r003"])
    labels = Dataset.open(dataset).select("train").labels
    assert done.data["mean"]["angle_rad"] == pytest.approx(labels.angle.mean(), abs=1e-6)
    stored = json.loads((run / "config.json").read_text())
    assert stored["config"]["seed"] == 7
    assert stored["recipe"]["name"] == "fast"
    gains = {"distance_beta": 0.05, "angle_beta": 1.0, "distance_gain": 2.5, "angle_gain": 5.0}
    assert stored["recipe"]["huber"] == gains
    curve = read_curves(run / "curves.csv")
    assert [point["step"] for point in curve] == [10]
    assert curve[0]["total_loss"] == pytest.approx(points[0].losses[3], rel=1e-4)
    assert list((run / "tensorboard").glob("events.out.*"))
    assert [path.suffix for path in list_checkpoints(run)] == [".safetensors"]


@pytest.mark.usefixtures("small_network")
def test_a_run_limited_by_time_ends(dataset: Path, tmp_path: Path) -> None:
    run = training_config(dataset, tmp_path / "timed", iterations=None, minutes=1 / 60)
    started = time.monotonic()
    card = train(run, None)
    assert card.iterations >= 1
    assert (
        1.0 <= time.monotonic() - started < 60.0
    )  # one second of steps, then the model is published


def test_a_folder_that_a_kill_has_left_empty_is_new(tmp_path: Path) -> None:
    """Killed before config.json was written, when neither the same command nor --resume would
    work."""
    run = tmp_path / "run"
    run.mkdir()
    require_new(run)
    (run / "config.json.partial").write_text("{")
    require_new(run)
    (run / "config.json").write_text("{}")
    with pytest.raises(UserError, match="already exists"):
        require_new(run)


@pytest.mark.usefixtures("small_network")
def test_wrong_configurations_are_refused_before_anything_is_written(
    dataset: Path, tmp_path: Path
) -> None:
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "mine").write_text("precious")
    with pytest.raises(UserError, match=r"kept already exists.*--resume"):
        train(training_config(dataset, tmp_path / "kept"), None)
    assert (tmp_path / "kept" / "mine").read_text() == "precious"
    with pytest.raises(UserError, match="no recorded rounds"):
        train(training_config(tmp_path / "kept", tmp_path / "new"), None)
    with pytest.raises(UserError, match="no recipe 'slow'"):
        train(training_config(dataset, tmp_path / "new", recipe="slow"), None)
    for device in ("gpu", "cpu:x", "cuda:x", "cuda:99", ""):
        with pytest.raises(UserError, match="--device"):
            train(training_config(dataset, tmp_path / "new", device=device), None)
    assert not (tmp_path / "new").exists()


def test_learning_rate_schedules() -> None:
    paper, fast = RECIPES["paper"], RECIPES["fast"]
    assert learning_rate(paper, 9_999, 0.1) == 1e-3
    assert learning_rate(paper, 30_000, 0.2) == pytest.approx(1e-3 * 0.9**3)
    assert (paper.batch, paper.iterations) == (32, 150_000)
    peak = fast.learning_rate
    assert learning_rate(fast, 0, 0.05) == pytest.approx(peak)
    assert learning_rate(fast, 0, 0.525) == pytest.approx(peak / 2)
    assert learning_rate(fast, 0, 1.0) == pytest.approx(0, abs=1e-12)


def test_a_run_of_continue_can_be_prolonged_until_its_rate_falls() -> None:
    """Minutes added within the first four fifths do not change the rates of earlier steps: 100
    steps per minute, planned for 20 minutes or for 200."""
    recipe = RECIPES["continue"]
    planned, prolonged = (
        [learning_rate(recipe, step, step / 100 / minutes) for step in range(0, 20 * 100, 50)]
        for minutes in (20.0, 200.0)
    )
    assert planned[0] > 0
    assert planned[2 : 16 * 2] == [recipe.learning_rate] * 30  # warm-up: 5 % of 20 minutes
    assert prolonged[10 : 16 * 2] == planned[10 : 16 * 2]  # warm-up: at most 500 steps
    assert prolonged[-1] == recipe.learning_rate
    assert planned[-1] < planned[-2] < planned[16 * 2 + 1] < recipe.learning_rate
    assert learning_rate(recipe, 2_000, 1.0) == learning_rate(recipe, 2_001, 1.2) == 0.0


@pytest.mark.parametrize(
    ("changes", "seen"),
    [
        ({"iterations": 0}, "--iterations is 0"),
        ({"minutes": 0.0}, "--minutes is 0"),
        ({"minutes": float("inf")}, "--minutes is inf"),
        ({"minutes": float("nan")}, "--minutes is nan"),
        ({"batch": 1}, "--batch is 1"),
        ({"seed": -1}, "--seed is -1"),
        ({"threads": -1}, "--threads is -1"),
        ({"threads": 2**31}, "--threads is 2147483648"),
    ],
)
def test_numbers_out_of_range_are_refused(changes: dict[str, Any], seen: str) -> None:
    with pytest.raises(UserError, match=seen):
        training_config(Path("data"), Path("out"), **changes)
