"""Collecting for real: same bytes twice, resuming, interruptions, crashes, a full disk."""

import ctypes
import errno
import json
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import trackfeatures as tf
from datagen.cli import main as datagen_main
from datagen.collect import _open_folder, _require_fitting, collect
from datagen.crew import Crew
from datagen.errors import RoundFailed
from datagen.plan import RoundPlan, Wanted, make_plan
from datagen.recording import Dataset
from datagen.recording.camera import CameraInfo
from datagen.recording.errors import DatasetError
from datagen.recording.folder import prepare, read_states
from datagen.recording.verify import verify
from datagen.tracks import choose_tracks
from datagen.worker import FramesDone, Hopeless, Job, Message, RoundBroken, RoundDone, _attempt
from simulator.state import Command
from tests.datagen.conftest import Samples

PR_CAPBSET_DROP, CAP_DAC_OVERRIDE = 24, 1  # <linux/prctl.h>, <linux/capability.h>
SHORT = ["--rounds", "2", "--frames", "30", "--tracks", "circuit", "--lanes", "1,2"]


def datagen(
    *args: object, preexec_fn: Callable[[], object] | None = None
) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "datagen", *map(str, args)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=120, preexec_fn=preexec_fn
    )


@pytest.fixture
def refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """Runs the command in this process; returns the one line that it was refused with."""

    def run(*args: object) -> str:
        monkeypatch.setattr(sys, "argv", ["datagen", *map(str, args)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            datagen_main()
        stdout, stderr = capsys.readouterr()
        assert (end.value.code, stdout, stderr.count("\n")) == (1, "", 1)
        return stderr

    return run


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("collect") / "data"
    done = datagen("collect", *SHORT, "--out", folder, "--workers", "2", "--json")
    assert done.returncode == 0, done.stderr
    assert "pybullet" not in done.stderr
    result = json.loads(done.stdout)
    assert (result["rounds"], result["frames"], result["resets"]) == (2, 60, 0)
    assert result["frames_per_second"] == pytest.approx(60 / result["seconds"], rel=0.01)
    return folder


def _jobs(folder: Path, rounds: int, frames: int) -> list[Job]:
    wanted = Wanted(rounds, frames, seed=1, tracks=choose_tracks(("oval",), None))
    plan = make_plan(wanted)
    prepare(folder)
    return [Job(entry, plan.hash, folder, None) for entry in plan.rounds]


def test_what_is_collected_verifies_and_reads(collected: Path) -> None:
    report = verify(collected, "deep")
    assert report.ok, report.problems
    dataset = Dataset.open(collected)
    assert {info.split for info in dataset.rounds} == {"train", "test"}
    frames = dataset.select("all")
    images = frames.read_batch(range(60), np.empty((60, 210, 280, 3), np.uint8))
    # A road is in the picture: neither black nor of one colour, the sky above it lighter.
    assert images.std(axis=(1, 2, 3)).min() > 10.0
    labels = frames.labels
    place = labels.to_middle[labels.round == 0]
    assert 0.0 < np.abs(np.diff(place)).max() < 0.3
    assert labels.speed.min() > 5.0


def test_verify_and_info_as_commands(
    collected: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    done = datagen("verify", collected, "--level", "full", "--json")
    report = json.loads(done.stdout)
    assert done.returncode == 0
    assert report == {"ok": True, "rounds": 2, "frames": 60, "problems": []}
    info = json.loads(datagen("info", collected, "--json").stdout)
    assert (info["rounds"], info["by_lanes"]) == (2, {"1": 30, "2": 30})
    assert "mean misses by" in datagen("info", collected).stdout
    nothing = datagen("verify", tmp_path / "nothing", "--json")
    assert nothing.returncode == 1
    assert not json.loads(nothing.stdout)["ok"]
    assert "no level 'slow'" in refused("verify", collected, "--level", "slow")


def test_the_same_plan_gives_the_same_bytes_with_another_number_of_workers(
    collected: Path, tmp_path: Path
) -> None:
    done = datagen("collect", *SHORT, "--out", tmp_path / "again", "--workers", "1")
    assert done.returncode == 0, done.stderr
    for path in sorted((collected / "rounds").iterdir()):
        assert path.read_bytes() == (tmp_path / "again" / "rounds" / path.name).read_bytes()


def test_a_finished_dataset_is_left_alone_and_a_lost_round_made_again(collected: Path) -> None:
    lost = collected / "rounds" / "round-001.mcap"
    kept = collected / "rounds" / "round-000.mcap"
    before, written = lost.read_bytes(), kept.stat().st_mtime_ns
    lost.unlink()
    done = datagen("collect", *SHORT, "--out", collected, "--json")
    assert json.loads(done.stdout)["recorded_frames"] == 30
    assert lost.read_bytes() == before
    assert kept.stat().st_mtime_ns == written
    done = datagen("collect", *SHORT, "--out", collected, "--json")
    assert (done.returncode, json.loads(done.stdout)["recorded_frames"]) == (0, 0)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--seed", "9"], "seed: 0 there, 9 asked for"),
        (["--tracks", "no-such-track"], "no track 'no-such-track'"),
        (["--lanes", "1,5"], "5 lanes asked for"),
        (["--lanes", "one"], "--lanes is 'one'"),
        (["--workers", "-1"], "-1 workers"),
        (["--tracks-dir", "/no/such/folder"], "no folder /no/such/folder"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    collected: Path, refused: Callable[..., str], args: list[str], message: str
) -> None:
    before = {path: path.stat().st_mtime_ns for path in collected.rglob("*")}
    assert message in refused("collect", *SHORT, "--out", collected, *args)
    assert {path: path.stat().st_mtime_ns for path in collected.rglob("*")} == before


def test_a_folder_of_something_else_is_not_touched(
    tmp_path: Path, refused: Callable[..., str]
) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    assert "is not a dataset" in refused("collect", *SHORT, "--out", tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]
    assert "is a file" in refused("collect", *SHORT, "--out", tmp_path / "thesis.tex")


@pytest.mark.parametrize("failing", range(5))
def test_a_disk_full_from_the_start_leaves_a_folder_that_can_be_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int
) -> None:
    """Each of the writes before the first round fails once; the same command then works."""
    folder = tmp_path / "data"
    plan = make_plan(Wanted(1, 10, seed=1, tracks=choose_tracks(("oval",), None)))
    synced: list[Path] = []

    def full(path: Path) -> None:
        synced.append(path)
        if len(synced) > failing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr("datagen.recording.folder._sync", full)
        with pytest.raises(OSError, match="No space left"):
            collect(plan, folder, workers=1)
    _require_fitting(folder, plan)
    _open_folder(folder, plan)
    assert json.loads((folder / "plan.json").read_text())["hash"] == plan.hash


def test_a_folder_without_permission_is_told_in_one_line(tmp_path: Path) -> None:
    """Without the capability to pass over modes, for where the tests run as root."""

    def humble() -> None:
        ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, 0, 0, 0)

    tmp_path.chmod(0o555)
    (plain := tmp_path.with_name("plain")).mkdir()
    plain.chmod(0o555)
    for folder in (tmp_path / "new", plain):
        done = datagen("collect", *SHORT, "--out", folder, preexec_fn=humble)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)
        assert done.stderr.startswith("error: no permission to write or read: ")
        assert str(folder) in done.stderr
    assert not list(plain.iterdir())


def test_empty_parts_of_a_dataset_are_no_foreign_folder(tmp_path: Path) -> None:
    plan = make_plan(Wanted(1, 10, seed=1, tracks=choose_tracks(("oval",), None)))
    (tmp_path / "rounds").mkdir()
    (tmp_path / "state").mkdir()
    (tmp_path / ".plan.json.new").write_text('{"rou')
    _require_fitting(tmp_path, plan)
    (tmp_path / "rounds" / "somebody.mcap").write_text("else's")
    with pytest.raises(DatasetError, match="is not a dataset"):
        collect(plan, tmp_path, workers=1)


def test_a_dataset_of_other_definitions_is_refused(tmp_path: Path) -> None:
    plan = make_plan(Wanted(1, 10, seed=1, tracks=choose_tracks(("oval",), None)))
    (tmp_path / "plan.json").write_text(json.dumps({**plan.as_json(), "definitions": "0-old"}))
    with pytest.raises(tf.DefinitionsMismatch, match="0-old"):
        collect(plan, tmp_path, workers=1)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_leaves_whole_rounds_only_and_is_resumed(
    tmp_path: Path, number: signal.Signals
) -> None:
    folder = tmp_path / "data"
    args = ["collect", "--rounds", "3", "--frames", "60", "--tracks", "oval", "--workers", "1"]
    command = [sys.executable, "-m", "datagen", *args, "--out", str(folder)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        _wait_for(lambda: list(folder.glob("state/*.json")), process)
        _wait_for(lambda: list(folder.glob(".partial/*/*.mcap")), process)
        process.send_signal(number)
        _, stderr = process.communicate(timeout=20)
    assert process.returncode == 130
    assert "Traceback" not in stderr
    kept = read_states(folder)
    assert 1 <= len(kept) < 3
    assert not (folder / ".partial").exists()
    assert len(list(folder.glob("rounds/*"))) == len(kept)
    assert verify(folder, "full").ok
    if number == signal.SIGINT:
        done = datagen(*args, "--out", folder, "--json")
        assert json.loads(done.stdout)["recorded_frames"] == 60 * (3 - len(kept))
        assert verify(folder, "full").ok


def test_a_worker_that_dies_costs_its_round_only_and_the_round_is_tried_again(
    tmp_path: Path,
) -> None:
    jobs = _jobs(tmp_path, rounds=2, frames=30)
    killed: list[str] = []
    done: list[str] = []

    def hear(message: FramesDone | RoundDone) -> None:
        if isinstance(message, RoundDone):
            done.append(message.state.id)
        elif not killed:
            killed.append(message.round_id)
            crew._workers[0].process.kill()

    crew = Crew(1, hear)
    assert crew.run(jobs) == []
    assert killed == ["round-000"]
    assert sorted(done) == ["round-000", "round-001"] == sorted(read_states(tmp_path))


def test_a_round_that_cannot_be_driven_is_tried_once_and_told_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    samples: Samples,
) -> None:
    """Forked workers take the stand-in for recording with them."""

    def record(plan: RoundPlan, plan_hash: str, path: Path, *rest: object) -> None:
        with (tmp_path / "attempts").open("a") as stream:
            stream.write(f"{plan.id}\n")
        if plan.id == "round-000":
            raise RoundFailed("the car left the road 21 times")
        header = replace(samples.header("r001"), id=plan.id, seed=plan.seed)
        samples.write(path, header, samples.frames(3, seed=1))

    monkeypatch.setattr("datagen.record.record_round", record)
    monkeypatch.setattr("datagen.crew.CONTEXT", multiprocessing.get_context("fork"))
    plan = make_plan(Wanted(2, 3, seed=1, tracks=choose_tracks(("oval",), None)))
    capfd.readouterr()  # what libraries said when they were loaded
    expected = r"1 of 2 rounds failed \(round-000: the car left the road 21 times\); what was"
    with pytest.raises(DatasetError, match=expected) as told:
        collect(plan, tmp_path / "data", workers=1)
    assert "another --seed" in str(told.value)
    assert (tmp_path / "attempts").read_text().split() == ["round-000", "round-001"]
    assert capfd.readouterr().err == ""
    assert list(read_states(tmp_path / "data")) == ["round-001"]
    assert verify(tmp_path / "data", "full").ok


def test_a_car_that_is_reset_too_often_ends_its_round(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("datagen.record.MOST_RESETS", 0)
    monkeypatch.setattr("datagen.record.ScriptedDriver.command", lambda *args: Command(1.0, 1.0))
    (job,) = _jobs(tmp_path, rounds=1, frames=200)
    job = replace(job, plan=replace(job.plan, camera=CameraInfo(width=56, height=42)))
    message = _attempted(job)
    assert isinstance(message, RoundBroken)
    assert message.final
    assert "left the road 1 times on oval, " in message.reason
    assert not list(tmp_path.glob("rounds/*"))


@pytest.mark.parametrize("reason", [errno.ENOSPC, errno.EACCES])
def test_a_full_disk_ends_a_round_without_a_trace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reason: int
) -> None:
    def full(*args: object) -> None:
        raise OSError(reason, os.strerror(reason))

    (job,) = _jobs(tmp_path, rounds=1, frames=10)
    monkeypatch.setattr("datagen.record.RoundWriter.add", full)
    message = _attempted(job)
    assert isinstance(message, Hopeless)
    assert isinstance(message.error, OSError)
    assert message.error.errno == reason
    assert not (tmp_path / ".partial").exists()
    assert not list(tmp_path.glob("rounds/*"))


def test_a_disk_that_fills_up_gives_one_line_and_keeps_the_rounds(collected: Path) -> None:
    """A limit on the size of files stands in for the full disk: the same write fails."""
    lost = collected / "rounds" / "round-001.mcap"
    before = lost.read_bytes()
    lost.unlink()
    limit = 400_000
    done = datagen(
        "collect", *SHORT, "--out", collected,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )  # fmt: skip
    assert done.returncode == 1
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert errors == [f"error: {os.strerror(errno.EFBIG)}"]
    assert "Traceback" not in done.stderr
    assert list(read_states(collected)) == ["round-000"]
    assert not (collected / ".partial").exists()
    assert datagen("collect", *SHORT, "--out", collected).returncode == 0
    assert lost.read_bytes() == before


def test_help_is_quick() -> None:
    code = "import sys, datagen.cli; print(*sorted({m.split('.')[0] for m in sys.modules}))"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    heavy = {"numba", "pybullet", "moderngl", "cv2", "mcap", "simulator"}
    assert not heavy & set(loaded.stdout.split())


def _attempted(job: Job) -> Message:
    ours, the_workers = multiprocessing.Pipe()
    with ours, the_workers:
        return _attempt(job, the_workers)


def _wait_for(found: Callable[[], object], process: subprocess.Popen[str]) -> None:
    stderr = process.stderr
    assert stderr is not None
    deadline = time.monotonic() + 60.0
    while not found():
        assert process.poll() is None, stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.02)
