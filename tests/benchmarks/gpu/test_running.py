"""What a GPU run keeps when a stage fails or it is stopped, and a rehearsal of all of it."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import packages_distributions, requires
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from benchmarks.gpu import report, wheels
from benchmarks.gpu.plan import REHEARSAL, STAGES, Plan
from benchmarks.gpu.process import Interrupted
from benchmarks.gpu.report import DONE, FAILED, SKIPPED, STOPPED, Report, timing
from benchmarks.gpu.running import run_stages
from benchmarks.gpu.stages import Run, StageFailed
from mtlnet.inference.curves import COLUMNS
from mtlnet.inference.model_card import read_card
from trackfeatures.errors import UserError

ROOT = Path(__file__).parents[3]


def task_of(folder: Path) -> Run:
    kept = Report(folder / "work", folder / "out", rehearsal=True)
    return Run(Plan(3.0), REHEARSAL, kept, time.monotonic(), "continue", None)


@pytest.mark.alone
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
    assert left["train"] == pytest.approx(0.25 * 0.3 * 202.0, abs=1.0)
    assert left["paper"] == pytest.approx(174.6 - 150.0, abs=1.0)
    over = task_of(tmp_path / "over")
    run_stages(replace(over, begin=time.monotonic() - 178.0), functions)
    assert {stage["why"] for stage in over.report.content["stages"].values()} == {
        *("no time is left", "stage collect_test is not done", "stage collect_train is not done"),
        "stage ship is not done",
    }


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
