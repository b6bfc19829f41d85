"""The prepared run on a GPU: its minutes, what it says is missing, and how it is stopped."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.metadata import distributions, packages_distributions, requires
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from benchmarks import gpu_run
from benchmarks.material.gpu import machine, process, report, stages, wheels
from benchmarks.material.gpu.collecting import (
    SEEDS,
    counted,
    evaluation_collections,
    most_frames,
    train_collections,
)
from benchmarks.material.gpu.plan import FULL, REHEARSAL, SECONDS, STAGES, Plan
from benchmarks.material.gpu.process import Command, Ended, Interrupted
from benchmarks.material.gpu.report import DONE, FAILED, SKIPPED, STOPPED, Report
from benchmarks.material.gpu.running import run_stages
from benchmarks.material.gpu.stages import Run, StageFailed, timing
from benchmarks.material.outcome import NOT_MEASURED
from mtlnet.inference.curves import COLUMNS
from mtlnet.inference.model_card import SHIPPED, read_card
from trackfeatures.errors import UserError

ROOT = Path(__file__).parents[2]


# The plan of minutes.


def test_deadlines_are_shares_of_the_minutes() -> None:
    plan = Plan(10.0)
    assert sum(SECONDS.values()) == 600.0
    deadlines = [plan.deadline(stage) for stage in STAGES]
    assert all(a < b for a, b in pairwise(deadlines))
    assert deadlines[-1] == 595.0  # five seconds are left to end
    assert (plan.deadline("forward"), plan.deadline("fast"), plan.deadline("train")) == (
        *(30.0, 245.0, 460.0),
    )
    assert [Plan(3.0).deadline(stage) for stage in STAGES] == pytest.approx(
        [0.3 * deadline for deadline in deadlines]
    )
    assert set(stages.STAGE_FUNCTIONS) == set(STAGES) == set(SECONDS) - {"check", "end"}
    for minutes in (0.5, 601.0, float("nan")):
        with pytest.raises(UserError, match="give 1 to 600"):
            Plan(minutes)


def test_the_training_takes_what_its_start_and_end_and_the_earlier_stages_leave() -> None:
    plan = Plan(10.0)
    on_time = plan.train_minutes(245.0, 60_000)
    assert on_time == pytest.approx((215 - 12 - 50 - 10) / 60)
    assert plan.train_minutes(185.0, 60_000) == pytest.approx(on_time + 1.0)
    assert plan.train_minutes(245.0, 10**7) == pytest.approx(0.25 * 215 / 60)
    assert plan.train_minutes(594.5, 0) == pytest.approx(1 / 60)


def test_a_stage_that_begins_late_has_its_own_time_until_the_run_ends() -> None:
    plan = Plan(10.0)
    assert plan.seconds("forward", 10.0) == 20.0  # five seconds were left before it
    assert plan.seconds("forward", 60.0) == 15.0
    assert plan.seconds("train", 300.0) == 160.0
    assert plan.seconds("train", 450.0) == 0.25 * 215.0
    assert plan.seconds("paper", 500.0) == 95.0
    assert plan.seconds("paper", 560.0) == 35.0
    assert plan.seconds("paper", 600.0) == 0.0


def test_stages_know_until_when_they_may_take_and_none_begins_after_the_end(
    tmp_path: Path,
) -> None:
    task = task_of(tmp_path)  # of three minutes
    left: dict[str, float] = {}

    def look(name: str) -> Callable[[Run], dict[str, Any]]:
        def work(task: Run) -> dict[str, Any]:
            left[name] = task.left()
            return {}

        return work

    functions = {name: look(name) for name in STAGES}
    run_stages(replace(task, begin=time.monotonic() - 150.0), functions)
    assert left["forward"] == pytest.approx(0.3 * 15.0, abs=1.0)
    assert left["train"] == pytest.approx(0.25 * 0.3 * 215.0, abs=1.0)
    assert left["paper"] == pytest.approx(178.5 - 150.0, abs=1.0)
    over = task_of(tmp_path / "over")
    run_stages(replace(over, begin=time.monotonic() - 178.0), functions)
    assert {stage["why"] for stage in over.report.content["stages"].values()} == {
        *("no time is left", "stage collect_test is not done", "stage collect_train is not done"),
        "stage ship is not done",
    }


def evaluation_collections_share_the_cores_and_no_seed() -> None:
    parts = train_collections(FULL, 16, 200_000)
    assert [part.workers for part in parts] == [4, 4, 4, 4]
    assert sum(part.rounds * part.frames for part in parts) == 200_000
    assert ["random" in part.options for part in parts] == [False, True, False, True]
    sets = evaluation_collections(FULL, 16)
    assert [(each.name, each.rounds * each.frames) for each in sets] == [
        ("test", 25_200),  # of which 20,000 are test frames
        ("unseen", 5_100),
        ("random", 5_100),
    ]
    assert 16 <= sum(each.workers for each in sets) <= 18
    seeds = [each.seed for each in (*parts, *sets)]
    assert len({*seeds}) == len(seeds) == len({each.name for each in (*parts, *sets)})
    trained_on = {seed // 10**6 for seed in read_card(SHIPPED).data["seeds"]}
    assert not trained_on & {*seeds, *SEEDS.values()}
    assert [part.workers for part in train_collections(REHEARSAL, 2, 64)] == [1, 1]


def test_no_more_frames_than_the_gpu_holds() -> None:
    assert most_frames(FULL, 0) == FULL.most_train_frames
    frames = most_frames(FULL, 80 * 10**9)
    assert frames * 144 * 280 * 3 == pytest.approx(40e9, rel=1e-4)


def evaluation_collections_that_were_stopped_count_their_finished_rounds(tmp_path: Path) -> None:
    (part,) = train_collections(REHEARSAL, 2, 8)[:1]
    (tmp_path / part.name).mkdir()
    found = counted(tmp_path, [part], [Ended(130, True, 2.0)])
    assert found == {
        "frames": {"part0": 0},
        "frames_per_second": None,
        "whole_frames_per_second": 0.0,
        "recording_was_stopped": True,
    }


# What is missing.


GOOD: dict[str, Any] = {
    "torch": "2.11",
    "gpu": "NVIDIA H100",
    "gpu_bytes": 8 * 10**10,
    "renderer": "NVIDIA H100/PCIe/SSE2",
    "tracks": 23,
    "torcs": True,
    "errors": {},
}


@pytest.mark.parametrize(
    ("changes", "lacks"),
    [
        ({}, []),
        ({"gpu": None}, ["gpu: torch 2.11 finds none"]),
        ({"renderer": "llvmpipe (LLVM 15.0.6, 256 bits)"}, ["egl: OpenGL draws on llvmpipe"]),
        ({"torcs": False}, ["tracks: TORCS's"]),
        ({"errors": {"egl": "no OpenGL 3.3"}, "renderer": None}, ["egl: no OpenGL 3.3"]),
        ({"errors": {"gpu": "no torch"}, "gpu": None}, ["gpu: no torch"]),
    ],
)
def test_what_a_machine_lacks(changes: dict[str, Any], lacks: list[str]) -> None:
    found = machine.missing({**GOOD, **changes})
    assert len(found) == len(lacks)
    assert all(text.startswith(start) for text, start in zip(found, lacks, strict=True))


def test_a_rehearsal_needs_no_gpu() -> None:
    software = {**GOOD, "gpu": None, "renderer": "llvmpipe"}
    assert machine.missing(software, gpu=False) == []


def test_missing_packages_are_named_before_anything_is_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert wheels.missing_packages() == []
    for name in ("simplejpeg", "google.protobuf", "absl"):
        monkeypatch.setitem(sys.modules, name, None)
    found, (lacks,) = machine.missing_at_all()
    assert found == {}
    assert lacks.startswith("packages: absl-py, protobuf, simplejpeg; bring them with --wheels")


def test_an_answer_that_is_no_json_is_an_error() -> None:
    assert machine.ask("print('{\"a\": 1}')") == {"a": 1}
    assert machine.ask("raise SystemExit('no EGL here')") == "no EGL here"
    assert machine.ask("") == "exit code 0"


def test_the_wheels_are_those_of_the_lock_and_the_checkout_has_a_version(tmp_path: Path) -> None:
    lock = (ROOT / "requirements.lock").read_text().splitlines()
    pinned = wheels.pinned()
    assert len(pinned) == 10
    assert all(f"{each} \\" in lock for each in pinned)
    with pytest.raises(UserError, match="holds no wheels"):
        wheels.install_wheels(tmp_path, tmp_path / "site")
    wheels.describe_checkout(tmp_path / "site")
    (about,) = distributions(name="driverview", path=[str(tmp_path / "site")])
    assert f'version = "{about.version}"' in (ROOT / "pyproject.toml").read_text()


def test_wheels_are_downloaded_for_the_machine_and_may_not_be_too_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[str]] = []

    def pip(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        asked.append(command)
        (Path(command[command.index("--dest") + 1]) / "mcap.whl").write_bytes(bytes(1_000))
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", pip)
    monkeypatch.setattr(sys, "argv", ["gpu_run.py", "--collect-wheels", str(tmp_path / "new")])
    assert gpu_run.main() == 0
    assert asked[0][-10:] == wheels.pinned()
    assert asked[0][asked[0].index("--python-version") + 1] == "3.12"
    assert "--only-binary=:all:" in asked[0]
    monkeypatch.setattr(wheels, "MAX_BYTES", 999)
    with pytest.raises(UserError, match=r"have 0\.0 MB, at most"):
        wheels.collect_wheels(tmp_path / "new")


def test_a_machine_that_lacks_something_starts_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("PYTHONPATH", "TORCS_TRACKS"):  # which are set for the commands of a run
        monkeypatch.setenv(name, "before")
    found = {**GOOD, "gpu": None, "torcs": False}
    monkeypatch.setattr(machine, "missing_packages", list)
    monkeypatch.setattr(machine, "describe_machine", lambda: found)
    words = ["--out", tmp_path / "out", "--work", tmp_path / "work", "--tracks", tmp_path]
    monkeypatch.setattr(sys, "argv", ["gpu_run.py", *map(str, words)])
    assert gpu_run.main() == NOT_MEASURED
    first, *lacks = capsys.readouterr().err.splitlines()
    assert first == "not measured: this machine lacks"
    assert [line.split(":")[0] for line in lacks] == ["  tracks", "  gpu"]
    assert not (tmp_path / "out").exists()
    assert os.environ["TORCS_TRACKS"] == str(tmp_path)
    assert os.environ["PYTHONPATH"].split(os.pathsep) == [
        *(str(ROOT), str(tmp_path / "work" / "site"), "before"),
    ]


# How commands are run and stopped.


def shell(folder: Path, script: str, name: str = "one") -> Command:
    return Command(("sh", "-c", script), folder / f"{name}.out", folder / f"{name}.log")


def test_commands_run_side_by_side_until_they_end(tmp_path: Path) -> None:
    both = [
        shell(tmp_path, "sleep 0.3; echo a", "a"),
        shell(tmp_path, "sleep 0.3; echo b >&2; exit 3", "b"),
    ]
    begin = time.monotonic()
    ended = process.run(both, 20.0)
    assert time.monotonic() - begin < 10.0
    assert [(each.code, each.stopped) for each in ended] == [(0, False), (3, False)]
    assert all(0.3 <= each.seconds < 10.0 for each in ended)
    assert (tmp_path / "a.out").read_text() == "a\n"
    assert process.log_tail(tmp_path / "b.log") == "b"


POLITE = "trap 'echo saved; exit 7' TERM; echo > {ready}; while :; do sleep 0.05; done"
STUBBORN = "trap '' TERM; echo > {ready}; while :; do sleep 0.05; done"


def test_commands_that_have_done_enough_may_save_and_are_then_killed(tmp_path: Path) -> None:
    ready = [tmp_path / "polite", tmp_path / "stubborn"]
    both = [
        shell(tmp_path, script.format(ready=path), path.name)
        for script, path in zip((POLITE, STUBBORN), ready, strict=True)
    ]
    polite, stubborn = process.run(
        both, 60.0, lambda: all(path.exists() for path in ready), grace_s=1.0
    )
    assert (polite.code, polite.stopped) == (7, True)
    assert (stubborn.code, stubborn.stopped) == (-signal.SIGKILL, True)
    assert (tmp_path / "polite.out").read_text() == "saved\n"


def test_a_command_is_stopped_at_its_deadline(tmp_path: Path) -> None:
    (ended,) = process.run([shell(tmp_path, "sleep 60")], 0.3)
    assert (ended.code, ended.stopped) == (-signal.SIGTERM, True)
    assert 0.3 <= ended.seconds < 30.0


@pytest.fixture
def own_signals() -> Iterator[None]:
    before = {each: signal.getsignal(each) for each in (signal.SIGTERM, signal.SIGINT)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("own_signals")
def test_a_signal_stops_the_commands_too(tmp_path: Path) -> None:
    process.raise_on_signals()
    ready = tmp_path / "ready"

    def enough() -> bool:
        if ready.exists():
            os.kill(os.getpid(), signal.SIGTERM)
        return False

    with pytest.raises(Interrupted) as raised:
        process.run([shell(tmp_path, POLITE.format(ready=ready))], 60.0, enough)
    assert raised.value.args == (signal.SIGTERM,)
    assert (tmp_path / "one.out").read_text() == "saved\n"


# What is kept.


def task_of(folder: Path) -> Run:
    kept = Report(folder / "work", folder / "out", rehearsal=True)
    return Run(Plan(3.0), REHEARSAL, kept, time.monotonic(), "continue", None)


def test_a_stage_that_fails_is_recorded_and_the_next_ones_run(tmp_path: Path) -> None:
    def fail(_: Run) -> dict[str, Any]:
        raise StageFailed("CUDA error", {"frames": 5})

    def refuse(_: Run) -> dict[str, Any]:
        raise UserError("no rounds")

    functions: dict[str, Callable[[Run], dict[str, Any]]] = dict.fromkeys(
        STAGES, lambda _: {"a": 1}
    )
    run_stages(task_of(tmp_path), {**functions, "collect_train": fail, "tests": refuse})
    content = json.loads((tmp_path / "out" / report.NAME).read_text())
    assert content == json.loads((tmp_path / "work" / report.NAME).read_text())
    found = content["stages"]
    assert found["collect_train"]["why"] == "CUDA error"
    assert found["collect_train"]["frames"] == 5
    assert "no rounds" in found["tests"]["why"]
    assert found["train"]["why"] == "stage collect_train is not done"
    skipped = ("train", "ship", "evaluate")
    expected = dict.fromkeys(STAGES, DONE) | dict.fromkeys(skipped, SKIPPED)
    expected |= {"collect_train": FAILED, "tests": FAILED}
    assert {name: stage["status"] for name, stage in found.items()} == expected


def test_a_run_that_was_stopped_goes_on_where_it_was(tmp_path: Path) -> None:
    ran: list[str] = []

    def stage(name: str) -> Callable[[Run], dict[str, Any]]:
        def work(task: Run) -> dict[str, Any]:
            if name == "evaluate" and name not in ran:
                ran.append(name)
                task.report.add(name, report.RUNNING, 1.0, {"test": 0.1})
                raise Interrupted(signal.SIGTERM)
            ran.append(name)
            return {"name": name}

        return work

    functions = {name: stage(name) for name in STAGES}
    with pytest.raises(Interrupted):
        run_stages(task_of(tmp_path), functions)
    assert ran == list(STAGES[:-1])
    stopped = task_of(tmp_path).report
    assert stopped.stage("evaluate")["status"] == STOPPED
    assert stopped.stage("evaluate")["test"] == 0.1
    assert "paper" not in stopped.content["stages"]
    ran_before = len(ran)
    run_stages(task_of(tmp_path), functions)
    assert ran[ran_before:] == ["evaluate", "paper"]
    with pytest.raises(UserError, match="of another kind of run"):
        Report(tmp_path / "work", tmp_path / "out", rehearsal=False)


def test_long_curves_are_thinned_and_keep_their_end(tmp_path: Path) -> None:
    kept = task_of(tmp_path).report
    curves = tmp_path / "curves.csv"
    curves.write_text("step,loss\n" + "".join(f"{10 * n},0.5\n" for n in range(1, 4_502)))
    kept.copy_curves(curves, "long.csv")
    with (kept.out / "long.csv").open() as file:
        header, *rows = csv.reader(file)
    assert header == ["step", "loss"]
    assert len(rows) == 1_501
    assert {int(b[0]) - int(a[0]) for a, b in pairwise(rows)} == {30}
    assert rows[-1] == ["45010", "0.5"]
    kept.copy_curves(tmp_path / "none.csv", "none.csv")
    assert not (kept.out / "none.csv").exists()


def test_times_of_steps_from_curves() -> None:
    def point(step: int, elapsed_s: float, speed: float) -> dict[str, float]:
        values = dict.fromkeys(COLUMNS, 0.0)
        return {**values, "step": step, "elapsed_s": elapsed_s, "images_per_second": speed}

    # Two seconds until the tenth step, then 1, 1 and 4 ms a step.
    points = [point(10, 2.0, 160.0), point(20, 2.01, 32e3), point(30, 2.02, 32e3)]
    found = timing([*points, point(40, 2.06, 8e3)])
    assert found["steps"] == 40
    assert found["train_seconds"] == 2.06
    assert found["images_per_second"] == pytest.approx(20e3)
    assert found["step_ms"] == pytest.approx(1.0)
    assert found["whole_run_s"] == pytest.approx(2.0 + 149_990 * 0.002, abs=0.06)
    assert timing(points[:1])["steps"] == 10
    assert timing([]) == {}


# All of it.


def foreign_imports() -> list[str]:
    """Names of installed modules that are neither listed nor required by a listed package."""
    known, todo = {"driverview", "pip", "setuptools"}, [*wheels.packages().values()]
    while todo:
        name = canonicalize_name(todo.pop())
        if name in known:
            continue
        known.add(name)
        needs = [Requirement(text) for text in requires(name) or ()]
        todo += [r.name for r in needs if r.marker is None or r.marker.evaluate({"extra": ""})]
    found = packages_distributions()
    return [
        name
        for name, packages in found.items()
        if re.fullmatch(r"\w+", name) and not {canonicalize_name(p) for p in packages} & known
    ]


HIDE = """
import sys
names = {!r}

class Refusing:
    def find_spec(self, name, path=None, target=None):
        if name == "gymnasium":
            raise ModuleNotFoundError("no gymnasium on such a machine")

# `simulator` looks whether gymnasium is among the modules.
sys.modules.update(dict.fromkeys(name for name in names if name != "gymnasium"))
sys.meta_path.insert(0, Refusing())
"""


@pytest.mark.extended
@pytest.mark.skipif("TORCS_TRACKS" not in os.environ, reason="TORCS_TRACKS names no folder")
def test_the_rehearsal_needs_only_the_listed_packages(tmp_path: Path) -> None:
    foreign = foreign_imports()
    assert {"openvino", "pybullet", "nncf", "onnx", "gymnasium", "fastapi"} <= {*foreign}
    hidden = tmp_path / "hidden"
    hidden.mkdir()
    (hidden / "sitecustomize.py").write_text(HIDE.format(foreign))
    out, work = tmp_path / "out", tmp_path / "work"
    command = [sys.executable, str(ROOT / "benchmarks" / "gpu_run.py"), "--rehearse"]
    command += ["--minutes", "15", "--out", str(out), "--work", str(work)]
    paths = os.pathsep.join([str(hidden), str(ROOT)])
    environment = {**os.environ, "PYTHONPATH": paths, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=1_200, check=False
    )
    assert (out / report.NAME).is_file(), done.stderr
    content = json.loads((out / report.NAME).read_text())
    found = content["stages"]
    assert {name: stage["status"] for name, stage in found.items()} == dict.fromkeys(STAGES, DONE)
    assert done.returncode == 0, done.stderr
    assert found["collect_test"]["frames"] == {"test": 60, "unseen": 6, "random": 12}
    assert sum(found["collect_train"]["frames"].values()) >= 16
    assert [each["batch"] for each in found["forward"]["ms"]] == [1, 4]
    assert found["train"]["steps"] == 10
    assert found["paper"]["steps"] >= 10
    assert found["ship"]["check"]["from_run_on_golden_image"] < 0.05
    for name in ("test", "unseen", "random"):
        assert found["evaluate"][name]["frames"] > 0
        assert found["evaluate"][name]["engine"] == "torch"
    names = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    model = {"card.json", "model.safetensors", "uncertainty.safetensors"}
    assert names == {
        *("gpu_run.json", "curves.csv", "curves-fast.csv", "curves-paper.csv"),
        *(f"model/{name}" for name in model),
    }
    assert sum((out / name).stat().st_size for name in names) < report.MAX_BYTES
    assert read_card(out / "model").iterations == 10
    again = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert again.returncode == 0, again.stderr
    assert not re.search(r"^ +[\d.]+ s  \w+$", again.stderr, re.MULTILINE)  # no stage ran again
