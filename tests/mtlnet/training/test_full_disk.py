"""A full disk: one clear message, no partial files, and a run that can be resumed."""

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any

import openvino
import pytest
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
from tensorboard.summary.writer.record_writer import RecordWriter

import runtime.files
from mtlnet.inference.curves import COLUMNS, read_curves
from mtlnet.inference.model_card import ModelError, read_card
from mtlnet.train import train
from mtlnet.training.checkpoint import list_checkpoints
from mtlnet.training.config import TrainConfig
from mtlnet.training.configure import resume_config
from mtlnet.training.logging import CurveLog
from runtime.files import atomic_write
from runtime.tensorboard import TensorBoardWriter
from trackfeatures.errors import UserError

pytestmark = pytest.mark.usefixtures("small_network", "short_fit")


def config(dataset: Path, out: Path, **changes: Any) -> TrainConfig:
    values = {"iterations": 2, "batch": 2, "device": "cpu", "threads": 1, **changes}
    return TrainConfig(dataset, out, **values)


def full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def left_over(run: Path) -> list[str]:
    return [p.name for p in run.rglob("*") if "partial" in p.name or "staged" in p.name]


def point(step: int) -> dict[str, float]:
    return dict.fromkeys(COLUMNS, 0.5) | {"step": step}


def test_a_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    atomic_write(path, b"old")
    monkeypatch.setattr("runtime.files.os.fsync", full)
    with pytest.raises(OSError, match="No space") as caught:
        atomic_write(path, b"new", fsync=True)
    assert caught.value.filename == str(path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_new_run_that_cannot_be_written_leaves_no_folder(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    new = config(dataset, tmp_path / "run", iterations=1)
    with monkeypatch.context() as broken:
        broken.setattr("runtime.files.os.fsync", full)
        with pytest.raises(OSError, match="No space"):
            train(new, None)
    assert not new.out.exists()
    train(new, None)


def fail_writing(monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    """Make writing `what` fail as on a full disk."""
    if what == "graph":

        def save_model(_model: object, path: str, **_: object) -> None:
            Path(path).write_text("half")
            raise RuntimeError("basic_ios::clear: iostream error")

        monkeypatch.setattr(openvino, "save_model", save_model)
    elif what == "curves":
        monkeypatch.setattr("mtlnet.training.logging.TensorBoardWriter.add", full)
    else:
        written: Callable[..., None] = runtime.files.atomic_write

        module = {"checkpoint": "training.checkpoint", "publish": "export.publish"}[what]

        def write(path: Path, content: bytes, *, fsync: bool) -> None:
            if path.suffix == ".safetensors" and path.name != "step-00000001.safetensors":
                full()
            written(path, content, fsync=fsync)

        monkeypatch.setattr(f"mtlnet.{module}.atomic_write", write)


@pytest.mark.parametrize(
    "what",
    [
        "checkpoint",
        *(
            pytest.param(each, marks=pytest.mark.extended)
            for each in ("curves", "publish", "graph")
        ),
    ],
)
def test_a_run_can_be_resumed_after_the_disk_was_full(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    monkeypatch.setattr("mtlnet.training.loop.LOG_EVERY", 1)
    new = config(dataset, tmp_path / "run")
    first = config(dataset, tmp_path / "run", iterations=1)
    with monkeypatch.context() as patch:
        patch.setattr("mtlnet.train.finish", lambda *_: None)
        with pytest.raises(ModelError, match="no finished model"):
            train(first, None)
    kept = [path.name for path in list_checkpoints(new.out)]
    assert kept == ["step-00000001.safetensors"]
    resumed, data = resume_config(new.out, {"iterations": 2})
    with monkeypatch.context() as patch:
        fail_writing(patch, what)
        with pytest.raises(UserError, match=rf"{new.out} broke off: .*--resume") as caught:
            train(resumed, data)
    assert "\n" not in str(caught.value)
    assert left_over(new.out) == []
    assert kept[0] in [path.name for path in list_checkpoints(new.out)]
    train(resumed, data)
    assert read_card(new.out).iterations == 2
    assert [row["step"] for row in read_curves(new.out / "curves.csv")] == [1, 2]


def test_partial_rows_are_omitted(tmp_path: Path) -> None:
    path = tmp_path / "curves.csv"
    with CurveLog(tmp_path, 0) as curves:
        for step in (10, 20, 30):
            curves.write(point(step))
    whole = path.read_text()
    for damage in (whole[:-1], whole[:-9], whole[:-30], whole + "40,1", whole + "\0\0\n40,\n"):
        path.write_text(damage)
        found = [row["step"] for row in read_curves(path)]
        assert found in ([10, 20], [10, 20, 30])
        with CurveLog(tmp_path, 20) as curves:
            curves.write(point(30))
        assert path.read_text() == whole
    path.write_text("step,elap")
    assert read_curves(path) == []


def test_a_failing_rewrite_keeps_the_curves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with CurveLog(tmp_path, 0) as curves:
        curves.write(point(10))
    monkeypatch.setattr("runtime.files.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        CurveLog(tmp_path, 10)
    assert [row["step"] for row in read_curves(tmp_path / "curves.csv")] == [10]


def test_the_tensorboard_writer_names_its_file_on_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = TensorBoardWriter(tmp_path)
    monkeypatch.setattr(RecordWriter, "write", full)
    with pytest.raises(OSError, match="No space") as caught:
        writer.add(1, {"loss": 0.5})
    assert caught.value.filename == str(next(tmp_path.iterdir()))
    writer.close()


def test_tensorboard_reads_the_points(tmp_path: Path) -> None:
    for first in (0, 10):
        with CurveLog(tmp_path, first) as curves:
            curves.write(point(first + 10))
    old, new = sorted((tmp_path / "tensorboard").iterdir())
    steps = [event.step for event in EventFileLoader(str(old)).Load() if event.summary.value]
    assert steps == [10]
    version, begin, scalars = EventFileLoader(str(new)).Load()
    assert version.file_version == "brain.Event:2"
    assert begin.step == 11
    assert {value.tag for value in scalars.summary.value} == {
        f"train/{name}" for name in COLUMNS if name != "step"
    }
