"""The stages of a GPU run: each runs commands of this project and returns their results.

The stages are in the order of `plan.STAGES`. A stage that fails raises StageFailed; the next stages
still run.
"""

import json
import re
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.gpu.collecting import (
    VARIED,
    Collection,
    counted,
    evaluation_collections,
    finished_frames,
    most_frames,
    train_collections,
)
from benchmarks.gpu.plan import Plan, Size
from benchmarks.gpu.process import Command, Ended, log_tail, run
from benchmarks.gpu.report import RUNNING, Report, timing
from benchmarks.gpu.wheels import ROOT
from mtlnet.inference.curves import CURVES, read_curves
from mtlnet.inference.model_card import CARD

MERGE_SHARE, LEAST_MERGE_S = 0.12, 30.0
"""Share of the time of the stage `collect_train` that is kept for merging its parts."""
START_S = 12.0
"""Seconds that a collection needs for imports and planning before it records, in a run of ten
minutes."""
EVALUATED = {"test": "test", "unseen": "unseen", "random": "unseen"}
"""The split of each dataset that is evaluated."""


class StageFailed(Exception):
    """Raised if a stage did not finish. The argument `why` is the reason, `found` has the results
    of the stage so far."""

    def __init__(self, why: str, found: dict[str, Any] | None = None) -> None:
        super().__init__(why)
        self.found = found or {}


@dataclass(frozen=True)
class Run:
    """Settings and report of a run, for all stages. `begin` is the start of the run, by
    `time.monotonic()`."""

    plan: Plan
    size: Size
    report: Report
    begin: float
    recipe: str
    given_batch: int | None
    until: float = 0.0
    """Deadline of the current stage, by `time.monotonic()`."""

    @property
    def work(self) -> Path:
        return self.report.work

    @property
    def batch(self) -> int | None:
        """Batch size of the training; None: the batch size of the recipe."""
        return self.given_batch or self.size.batch

    @property
    def cores(self) -> int:
        return int(self.report.content["machine"]["cores"])

    def left(self) -> float:
        """Seconds until the deadline of the current stage."""
        return self.until - time.monotonic()

    def command(self, name: str, *words: str, openmp_threads: int | None = None) -> Command:
        """Return the command `python WORDS`. Its output is `name`.out and its log `name`.log, both
        in `work`."""
        threads = {} if openmp_threads is None else {"OMP_NUM_THREADS": str(openmp_threads)}
        out, log = self.work / f"{name}.out", self.work / f"{name}.log"
        return Command((sys.executable, *words), out, log, threads)


def forward(task: Run) -> dict[str, Any]:
    """Time the shipped network's forward pass; return the times in ms for each batch size."""
    size = task.size
    command = task.command(
        "forward",
        *("-m", "benchmarks.gpu.forward", "--device", size.device),
        *("--batches", ",".join(map(str, size.batches)), "--passes", str(size.passes)),
    )
    (ended,) = run([command], task.left())
    lines = command.out.read_text().splitlines()
    found = {"ms": [json.loads(line) for line in lines if line.endswith("}")]}
    _require_ended(command, ended, found)
    return found


def compile_code(task: Run) -> dict[str, Any]:
    """Compile the simulator's numeric code once, before many processes need it."""
    command = task.command(
        "compile",
        *("-m", "datagen", "collect", "--json", "--rounds", "2", "--frames", "3"),
        *("--workers", "1", *VARIED[:2], "--tracks", "random,oval"),
        *("--out", str(task.work / "compile")),
    )
    (ended,) = run([command], task.left())
    _require_ended(command, ended)
    return {}


def gpu_tests(task: Run) -> dict[str, Any]:
    """Run the tests marked `gpu`. Only their files are read, because others need more packages."""
    marked = [p for p in sorted((ROOT / "tests").rglob("test_*.py")) if "mark.gpu" in p.read_text()]
    files = [str(path.relative_to(ROOT)) for path in marked]
    command = task.command(
        "tests",
        *("-m", "pytest", "--rootdir", str(ROOT), "-c", str(ROOT / "pyproject.toml")),
        *("-p", "no:cacheprovider", "-m", "gpu", *(str(path) for path in marked)),
    )
    (ended,) = run([command], task.left())
    said = command.out.read_text(errors="replace")
    counts = re.findall(r"(\d+) (passed|failed|skipped|errors?)\b", said)
    found = {"files": files, **{name: int(count) for count, name in counts}}
    if ended.code or ended.stopped:
        raise StageFailed("\n".join(said.splitlines()[-30:]) or log_tail(command.log), found)
    return found


def collect_test(task: Run) -> dict[str, Any]:
    """Collect the three datasets for evaluation until the deadline. On a slow machine they have
    fewer rounds than planned."""
    collections = evaluation_collections(task.size, task.cores)
    commands = [each.command(task.work) for each in collections]
    ended = run(commands, task.left())
    found = counted(task.work, collections, ended)
    require_recorded(collections, commands, ended, found)
    if not found["frames"]["test"]:
        raise StageFailed("no round was finished in time", found)
    return found


def collect_train(task: Run) -> dict[str, Any]:
    """Collect the dataset for the training, as large as time and GPU memory allow."""
    seconds = (1 - MERGE_SHARE) * task.left()
    if "train_frames" not in task.report.content:  # a continued run keeps its plans
        most = most_frames(task.size, task.report.content["machine"]["gpu_bytes"])
        before = task.report.stage("collect_test")
        start = START_S * task.plan.scale
        speed = before["frames_per_second"]
        if speed is None:  # the whole time includes the start
            whole_s = before["collecting_seconds"]
            speed = sum(before["frames"].values()) / max(whole_s - start, 0.2 * whole_s)
        fitting = int(speed * (seconds - start))
        task.report.save(train_frames=max(min(most, fitting), 1))
    frames = task.report.content["train_frames"]
    collections = train_collections(task.size, task.cores, frames)
    commands = [each.command(task.work) for each in collections]
    ended = run(commands, seconds)
    found = counted(task.work, collections, ended)
    require_recorded(collections, commands, ended, found)
    parts = [str(task.work / name) for name, frames in found["frames"].items() if frames]
    if not parts:
        raise StageFailed("no round was finished in time", found)
    merge = task.command("merge", "-m", "datagen", "merge", *parts, "--out", str(_train_set(task)))
    (merged,) = run([merge], max(task.left(), LEAST_MERGE_S * task.plan.scale))
    found["merged_frames"] = finished_frames(_train_set(task))
    if not (merged.stopped and found["merged_frames"]):  # a part of the rounds can be trained on
        _require_ended(merge, merged, found)
    return found


def time_fast(task: Run) -> dict[str, Any]:
    """Train with recipe `fast` and return its speed."""
    return _time_recipe(task, "fast")


def time_paper(task: Run) -> dict[str, Any]:
    """Train with recipe `paper` for `Size.timed_steps` steps, or fewer if the time ends. Return the
    time of a step and the extrapolated time of all 150,000 steps."""
    return _time_recipe(task, "paper")


def _time_recipe(task: Run, recipe: str) -> dict[str, Any]:
    """Run `mtlnet train`, stop it after its last step, and return `timing` of its curves."""
    folder, steps = task.work / f"timed-{recipe}", task.size.timed_steps[recipe]
    resume = ("--resume",) if (folder / "config.json").is_file() else ()
    command = task.command(
        recipe,
        *("-m", "mtlnet", "train", "--recipe", recipe, "--iterations", str(steps), *resume),
        *(() if task.size.batch is None else ("--batch", str(task.size.batch))),
        *("--data", str(task.work / "test"), "--out", str(folder), "--device", task.size.device),
    )

    def enough() -> bool:
        points = read_curves(folder / CURVES)
        return bool(points) and points[-1]["step"] >= steps

    (ended,) = run([command], task.left(), enough)
    task.report.copy_curves(folder / CURVES, f"curves-{recipe}.csv")
    found = timing(read_curves(folder / CURVES))
    if not found:
        raise StageFailed(log_tail(command.log) or "no ten steps were trained")
    if ended.code and not ended.stopped:
        raise StageFailed(log_tail(command.log), found)
    return found


def train(task: Run) -> dict[str, Any]:
    """Train the model: recipe `fast` from new weights, or `continue` from the shipped weights."""
    folder = task.work / "train"
    points = read_curves(folder / CURVES)
    frames = task.report.stage("collect_train").get("merged_frames", 0)
    now = time.monotonic() - task.begin
    minutes = task.plan.train_minutes(now, frames)
    before = points[-1]["elapsed_s"] / 60.0 if points else 0.0
    words = ["-m", "mtlnet", "train", "--json", "--out", str(folder)]
    words += ["--data", str(_train_set(task)), "--device", task.size.device]
    if (folder / "config.json").is_file():
        words += ["--resume"]
    else:
        words += ["--recipe", task.recipe, "--seed", "1"]
        words += ["--init", "default"] if task.recipe == "continue" else []
        words += ["--batch", str(task.batch)] if task.batch else []
    if task.size.iterations is not None:
        words += ["--iterations", str(task.size.iterations)]
    else:
        words += ["--minutes", f"{before + minutes:.3f}"]
    command = task.command("train", *words)
    (ended,) = run([command], task.left())
    task.report.copy_curves(folder / CURVES, "curves.csv")
    found = {"frames": frames, "planned_minutes": round(minutes, 2)}
    found |= timing(read_curves(folder / CURVES))
    found.pop("whole_run_s", None)
    if ended.code or ended.stopped:
        raise StageFailed(log_tail(command.log), found)
    return found


def ship(task: Run) -> dict[str, Any]:
    """Ship the model with float16 weights; from the last checkpoint if training was stopped."""
    found: dict[str, Any] = {}
    folder = task.work / "train"
    if not (folder / CARD).is_file():
        module = "benchmarks.gpu.publish_checkpoint"
        publish = task.command("publish", "-m", module, str(folder))
        (ended,) = run([publish], task.left())
        _require_ended(publish, ended)
        found["from_checkpoint"] = int(publish.out.read_text())
    words = ("-m", "mtlnet", "ship", "--json", "--model", str(folder), "--out", str(_model(task)))
    command = task.command("ship", *words)
    if not (_model(task) / CARD).is_file():
        (ended,) = run([command], task.left())
        _require_ended(command, ended)
        found |= json.loads(command.out.read_text())
    task.report.copy_model(_model(task))
    return {name: value for name, value in found.items() if name != "out"}


def evaluate(task: Run) -> dict[str, Any]:
    """Evaluate the model with torch on the datasets of `collect_test`; return the reports."""
    found: dict[str, Any] = {}
    recorded = task.report.stage("collect_test")["frames"]
    for name, split in EVALUATED.items():
        if not recorded[name]:
            continue
        command = task.command(
            f"evaluate-{name}",
            *("-m", "mtlnet", "evaluate", "--json", "--engine", "torch", "--split", split),
            *("--model", str(_model(task)), "--data", str(task.work / name)),
            openmp_threads=1,
        )
        (ended,) = run([command], task.left())
        _require_ended(command, ended, found)
        found[name] = {**json.loads(command.out.read_text()), "data": name}
        task.report.add("evaluate", RUNNING, ended.seconds, found)
    return found


STAGE_FUNCTIONS: dict[str, Callable[[Run], dict[str, Any]]] = {
    "forward": forward,
    "compile": compile_code,
    "tests": gpu_tests,
    "collect_test": collect_test,
    "collect_train": collect_train,
    "fast": time_fast,
    "train": train,
    "ship": ship,
    "evaluate": evaluate,
    "paper": time_paper,
}
NEEDS = {
    "collect_train": "collect_test",
    "fast": "collect_test",
    "paper": "collect_test",
    "train": "collect_train",
    "ship": "collect_train",
    "evaluate": "ship",
}
"""The stage that must be done before. `ship` does not need `train`: it also ships a checkpoint."""


def _train_set(task: Run) -> Path:
    return task.work / "train-set"


def _model(task: Run) -> Path:
    return task.work / "model"


def require_recorded(
    collections: list[Collection],
    commands: list[Command],
    ended: list[Ended],
    found: dict[str, Any],
) -> None:
    """Raise StageFailed if a collection ended with an error and without a finished round. A
    collection that lost only some of its rounds, for example because a car touched a wall where
    PyBullet is missing, is used."""
    for each, command, end in zip(collections, commands, ended, strict=True):
        if not end.stopped and not found["frames"][each.name]:
            _require_ended(command, end, found)


def _require_ended(command: Command, ended: Ended, found: dict[str, Any] | None = None) -> None:
    """Raise StageFailed with the end of the log if the command was stopped or returned an error."""
    if ended.stopped:
        raise StageFailed(f"stopped after {ended.seconds:.0f} s; {log_tail(command.log)}", found)
    if ended.code:
        raise StageFailed(log_tail(command.log) or f"exit code {ended.code}", found)
