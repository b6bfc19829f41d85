"""A stopped or killed run continues, and its weights are those of an uninterrupted one."""

import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from itertools import chain, repeat
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

import mtlnet.training.loop
from datagen.recording import Dataset
from mtlnet.export.ship import _without_folders
from mtlnet.inference.curves import read_curves
from mtlnet.inference.model_card import WEIGHTS, ModelError, read_card
from mtlnet.train import train
from mtlnet.training.checkpoint import list_checkpoints
from mtlnet.training.configure import new_config, resume_config
from mtlnet.training.loop import Stopped
from mtlnet.training.recipes import find_recipe
from mtlnet.training.run import create_run
from runtime.files import locked_folder
from tests.mtlnet.conftest import training_config, write_dataset
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

pytestmark = pytest.mark.usefixtures("short_fit", "no_graph")


def stop_after(steps: int) -> Callable[..., AbstractContextManager[Callable[[], bool]]]:
    """Replaces `interrupts`: a stop is requested after this many steps; read before each step."""
    return lambda *_: nullcontext(chain(repeat(False, steps), repeat(True)).__next__)


@pytest.mark.parametrize(
    ("recipe", "balance"),
    [("fast", "dwa"), pytest.param("paper", "uncertainty", marks=pytest.mark.extended)],
)
def test_a_resumed_run_equals_an_uninterrupted_one(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recipe: str, balance: str
) -> None:
    monkeypatch.setattr("mtlnet.training.losses.task_weighting.WINDOW_STEPS", 1)
    monkeypatch.setattr("mtlnet.training.loop.LOG_EVERY", 1)
    train(training_config(dataset, tmp_path / "whole", recipe=recipe, balance=balance), None)
    broken = training_config(dataset, tmp_path / "broken", recipe=recipe, balance=balance)
    with monkeypatch.context() as patch:
        patch.setattr(mtlnet.training.loop, "interrupts", stop_after(2))
        with pytest.raises(Stopped, match="step-00000002"):
            train(broken, None)
    with pytest.raises(ModelError, match="no finished model"):
        read_card(broken.out)
    resumed, data = resume_config(broken.out, {})
    assert resumed == broken
    train(resumed, data)
    assert differing_weights(tmp_path / "whole", broken.out) == []
    weights = [weights_in(tmp_path / run) for run in ("whole", "broken")]
    assert weights[0] == weights[1]
    assert len({tuple(row) for row in weights[0]}) > 1  # they move


def differing_weights(one: Path, other: Path) -> list[str]:
    """Names of the weights that are not bit-equal in two runs."""
    a, b = load_file(one / WEIGHTS), load_file(other / WEIGHTS)
    return [name for name in a if not np.array_equal(a[name], b[name])]


def weights_in(run: Path) -> list[list[float]]:
    """The task weights during a run."""
    names = ("distance_weight", "angle_weight", "type_weight")
    return [[point[name] for name in names] for point in read_curves(run / "curves.csv")]


KILLED = """
import os, signal, sys
from pathlib import Path
import mtlnet.train, mtlnet.training.loop, runtime.files
from mtlnet.training.config import TrainConfig
sync, seen = os.fsync, []
def die(file):
    if os.readlink(f"/proc/self/fd/{file}").endswith("00000004.safetensors.partial"):
        os.kill(os.getpid(), signal.SIGKILL)
    sync(file)
runtime.files.os.fsync = die
mtlnet.training.loop.CHECKPOINT_SECONDS = 0.0
data, out = map(Path, sys.argv[1:])
given = {"iterations": 6, "batch": 4, "seed": 7, "device": "cpu", "threads": 1}
mtlnet.train.train(TrainConfig(data, out, **given), None)
"""


@pytest.mark.extended
def test_a_run_killed_while_saving_resumes_from_the_checkpoint_before(
    dataset: Path, tmp_path: Path
) -> None:
    killed = tmp_path / "killed"
    done = subprocess.run([sys.executable, "-c", KILLED, dataset, killed], capture_output=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert [path.name for path in list_checkpoints(killed)][-1] == "step-00000003.safetensors"
    resumed, data = resume_config(killed, {})
    train(resumed, data)
    train(training_config(dataset, tmp_path / "whole", iterations=6), None)
    assert differing_weights(tmp_path / "whole", killed) == []


@pytest.mark.usefixtures("small_network")
def test_a_run_resumed_with_more_iterations_and_stopped_again_goes_on_to_them(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = training_config(dataset, tmp_path / "run", iterations=2)
    with monkeypatch.context() as patch:
        patch.setattr(mtlnet.training.loop, "interrupts", stop_after(1))
        with pytest.raises(Stopped):
            train(run, None)
        with pytest.raises(Stopped):
            train(*resume_config(run.out, {"iterations": 4}))
    resumed, data = resume_config(run.out, {})  # as the message of a stopped run says
    assert resumed == replace(run, iterations=4)
    assert train(resumed, data).iterations == 4


@pytest.mark.usefixtures("small_network")
def test_a_run_is_not_resumed_with_another_seed_or_other_data(
    dataset: Path, tmp_path: Path
) -> None:
    run = training_config(dataset, tmp_path / "run", iterations=1)
    train(run, None)
    with pytest.raises(UserError, match="started with seed 7, now 8"):
        resume_config(run.out, {"seed": 8})
    resumed, data = resume_config(run.out, {"iterations": 2, "seed": 7})
    assert resumed.iterations == 2
    with pytest.raises(ModelError, match=r"content hash .* is not the one"):
        train(resumed, {**data, "content_hash": "other"})
    list_checkpoints(run.out)[-1].write_bytes(b"rubbish")
    with pytest.raises(ModelError, match="cannot be read"):
        train(resumed, data)


@pytest.mark.usefixtures("small_network")
def test_a_run_is_not_trained_by_two_processes(dataset: Path, tmp_path: Path) -> None:
    run = training_config(dataset, tmp_path / "run", iterations=1)
    train(run, None)
    resumed, data = resume_config(run.out, {"iterations": 2})
    with locked_folder(run.out), pytest.raises(UserError, match="another process is writing to"):
        train(resumed, data)
    assert train(resumed, data).iterations == 2


@pytest.mark.usefixtures("small_network")
def test_a_run_continues_on_other_data_if_told_to(dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    other_dataset = write_dataset(tmp_path / "other", first_seed=100)
    run = training_config(dataset, tmp_path / "run", iterations=1)
    first = train(run, None).data
    given = {"iterations": 2, "data": other_dataset, "change_data": True}
    changed = train(*resume_config(run.out, given)).data
    kept = {name: first[name] for name in ("path", "content_hash", "frames")}
    assert changed["earlier"] == [kept]
    assert changed["content_hash"] == Dataset.open(other_dataset).content_hash
    assert first["seeds"] == {"count": 3, "ranges": "0..2"}
    assert changed["seeds"] == {"count": 6, "ranges": "0..2 100..102"}
    # From now on the other dataset is the run's data; the earlier one stays in its history.
    resumed, data = resume_config(run.out, {"iterations": 3})
    assert resumed.data == other_dataset
    assert not resumed.change_data
    card = train(resumed, data)
    assert card.data == changed
    assert card.iterations == 3
    assert _without_folders(card.data)["earlier"][0]["path"] == dataset.name


@pytest.mark.usefixtures("small_network")
def test_a_run_from_a_model_continues_on_other_data_and_names_that_model(
    dataset: Path, tmp_path: Path
) -> None:
    (tmp_path / "other").mkdir()
    other_dataset = write_dataset(tmp_path / "other", first_seed=100)
    model = train(training_config(dataset, tmp_path / "model", iterations=1), None)
    options = {"recipe": "continue", "init": str(tmp_path / "model"), "iterations": 1}
    run = training_config(dataset, tmp_path / "run", **options)
    first = train(run, None).data
    assert first["init"]["model_hash"] == model.model_hash
    given = {"iterations": 2, "data": other_dataset, "change_data": True}
    changed = train(*resume_config(run.out, given)).data
    assert changed["init"] == first["init"]
    hashes = [data["content_hash"] for data in changed["earlier"]]
    assert hashes == [model.data["content_hash"], first["content_hash"]]
    assert changed["content_hash"] == Dataset.open(other_dataset).content_hash


@pytest.mark.usefixtures("small_network")
def test_a_run_does_not_continue_on_images_of_another_camera(dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    camera = CameraParameters(fov_y_deg=50.0)
    other_dataset = write_dataset(tmp_path / "other", first_seed=100, camera=camera)
    run = training_config(dataset, tmp_path / "run", iterations=1)
    train(run, None)
    given = {"iterations": 2, "data": other_dataset, "change_data": True}
    with pytest.raises(ModelError, match=r"camera of .* fov_y_deg 50 instead of 67\.5"):
        train(*resume_config(run.out, given))
    assert read_card(run.out).iterations == 1


@pytest.mark.usefixtures("small_network")
def test_a_run_is_resumed_though_its_model_has_been_replaced(dataset: Path, tmp_path: Path) -> None:
    """The name of a model may stand for another one later, as `default` after an update. Without a
    checkpoint the run would need the old weights."""
    train(training_config(dataset, tmp_path / "model", iterations=1), None)
    options = {"recipe": "continue", "init": str(tmp_path / "model"), "iterations": 1}
    run = training_config(dataset, tmp_path / "run", **options)
    first = train(run, None).data
    shutil.rmtree(tmp_path / "model")
    train(training_config(dataset, tmp_path / "model", iterations=1, seed=8), None)
    card = train(*resume_config(run.out, {"iterations": 2}))
    assert (card.iterations, card.data) == (2, first)
    for checkpoint in list_checkpoints(run.out):
        checkpoint.unlink()
    with pytest.raises(ModelError, match=r"has no checkpoint, and the model .* is not the one"):
        train(*resume_config(run.out, {"iterations": 3}))


@pytest.mark.usefixtures("small_network")
def test_a_run_is_resumed_though_its_model_is_gone(dataset: Path, tmp_path: Path) -> None:
    train(training_config(dataset, tmp_path / "model", iterations=1), None)
    options = {"recipe": "continue", "init": str(tmp_path / "model"), "iterations": 1}
    run = training_config(dataset, tmp_path / "run", **options)
    first = train(run, None).data
    shutil.rmtree(tmp_path / "model")
    card = train(*resume_config(run.out, {"iterations": 2}))
    assert (card.iterations, card.data) == (2, first)
    for checkpoint in list_checkpoints(run.out):
        checkpoint.unlink()
    with pytest.raises(ModelError, match=r"there is no run .*model"):
        train(*resume_config(run.out, {"iterations": 3}))


def test_a_run_is_resumed_with_the_model_named_as_at_its_start(
    published: Path, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("runs").mkdir()
    shutil.copytree(published, "runs/mine")
    Path("link").symlink_to("runs/mine")
    for init, others in (
        ("default", ["default"]),
        ("mine", ["runs/mine", "./runs/mine", "link", str(tmp_path / "runs/mine")]),
    ):
        given = {"init": init, "data": dataset, "batch": 4, "device": "cpu"}
        config = new_config(given, tmp_path / f"from-{init}")
        create_run(config, find_recipe(config.recipe), {})
        for name in (init, *others):
            assert resume_config(config.out, {**given, "init": name})[0] == config
        with pytest.raises(UserError, match=r"was started with init .*, now varied is given"):
            resume_config(config.out, {"init": "varied"})
    shutil.rmtree("runs/mine")
    assert resume_config(config.out, {"init": "runs/mine"})[0] == config
    with pytest.raises(UserError, match="now none is given"):
        resume_config(config.out, {"init": "none"})
