"""Runs the paper's ablation: `mtlnet ablate --out FOLDER --iterations N --seeds 1,2,3`.

The folder contains `runs/ROW-seedS`, `ablation.json` and `ablation.html`. Both files are rewritten
after every finished run, so that the page can be read while the ablation continues.
"""

import os
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from rich.console import Console

from datagen.recording import Dataset
from mtlnet.ablation.config import AblationConfig
from mtlnet.ablation.plan import (
    COLUMNS,
    ERRORS,
    LOSSES,
    TASK_NAMES,
    Row,
    Run,
    Train,
    best,
    finish_runs,
    plan_runs,
    require_same_settings,
    table,
    training_config,
    training_curve,
)
from mtlnet.architecture import find_architecture
from mtlnet.data.loader import Loader
from mtlnet.data.rounds import open_training_dataset, require_decodable
from mtlnet.evaluation.evaluate import evaluate
from mtlnet.inference.curves import CURVES, read_curves
from mtlnet.inference.engine import load_engine
from mtlnet.train import train
from mtlnet.training.config import TrainConfig
from mtlnet.training.device import choose_device
from mtlnet.training.loop import TrainProgress
from mtlnet.training.recipes import find_recipe
from mtlnet.training.trainer import Trainer
from runtime.files import atomic_write, write_json
from runtime.html import render
from runtime.svg_charts import Line, Plot, line_plot
from trackfeatures.errors import UserError

TIMED_STEPS = 2
REPORT_SECONDS = 30.0


def ablate(config: AblationConfig, rows: Sequence[Row], *, dry_run: bool = False) -> dict[str, Any]:
    """Run an ablation, or only plan it with `dry_run`; returns the result that `--json` prints.

    Raises UserError for options that a training refuses, when the folder contains an ablation with
    other settings, or when a run fails.
    """
    console = Console(stderr=True, markup=False)
    runs = plan_runs(config, rows)
    for run in runs:
        training_config(config, run)  # raises for a refused option, before settings are written
    dataset = open_training_dataset(config.data)
    dataset.select(config.split)  # raises if the dataset has no rounds of this split
    if dry_run:
        return _plan_with_times(config, runs, dataset, console)
    for side in ("train", config.split):  # once for all runs
        require_decodable(dataset.select(side), dataset.path)
    require_same_settings(config, dataset.content_hash)
    for number, run in enumerate(
        finish_runs(config, runs, _train_with_messages(console), _evaluate_run), 1
    ):
        console.print(f"{number} of {len(runs)}: {run.folder} is finished")
        write_result(config, rows, runs)
    console.print(f"the table: {config.out / 'ablation.html'}")
    return write_result(config, rows, runs)


def write_result(config: AblationConfig, rows: Sequence[Row], runs: list[Run]) -> dict[str, Any]:
    """Write `ablation.json` and `ablation.html` for the finished runs; returns the content of
    `ablation.json`."""
    entries = table(rows, runs)
    result = {**config.shared_settings(), "data": str(config.data), "rows": entries}
    write_json(config.out / "ablation.json", result)
    atomic_write(config.out / "ablation.html", page(config, entries, rows, runs), fsync=True)
    return result


def _train_with_messages(console: Console) -> Train:
    """Return a function that trains a run and prints a message every `REPORT_SECONDS`."""

    def train_run(config: TrainConfig, resumed: dict[str, Any] | None) -> None:
        printed = time.perf_counter()
        console.print(f"training {config.out}")

        def report(progress: TrainProgress) -> None:
            nonlocal printed
            if time.perf_counter() - printed > REPORT_SECONDS:
                printed = time.perf_counter()
                console.print(
                    f"  step {progress.step} of {config.iterations}, "
                    f"{progress.images_per_second:.0f} images/s"
                )

        try:
            train(config, resumed, report, checked=True)
        except UserError as error:
            raise UserError(f"the run in {config.out} failed: {error}") from error

    return train_run


def _evaluate_run(run: Path, config: AblationConfig) -> dict[str, Any]:
    """Evaluate a finished run in float32 on the split `config.split`."""
    engines = [load_engine(run, "openvino", "f32") for _ in range(os.cpu_count() or 1)]
    return evaluate(engines, config.data, config.split, every=config.every)


def _plan_with_times(
    config: AblationConfig, runs: Sequence[Run], dataset: Dataset, console: Console
) -> dict[str, Any]:
    """Print and return the plan: the runs, each with the seconds of training that remain."""
    seconds = {
        name: step_seconds(config, name, runs, dataset)
        for name in dict.fromkeys(run.row.network for run in runs)
    }
    plan: list[dict[str, Any]] = []
    for run in runs:
        left = 0.0 if run.state == "finished" else config.iterations * seconds[run.row.network]
        alpha = list(run.row.alpha)
        plan.append(
            {
                "run": str(run.folder),
                "network": run.row.network,
                "alpha": alpha,
                "seed": run.seed,
                "state": run.state,
                "seconds": round(left),
            }
        )
        console.print(f"{run.folder}  {run.row.network} {alpha}: {run.state}, {left / 60:.1f} min")
    total: int = sum(entry["seconds"] for entry in plan)
    console.print(f"{len(runs)} runs of {config.iterations} steps, about {total / 3600:.1f} h left")
    return {"runs": plan, "seconds": total, "step_seconds": seconds}


def step_seconds(
    config: AblationConfig, network: str, runs: Sequence[Run], dataset: Dataset
) -> float:
    """Return the median seconds per training step of the finished runs of `network`. If none is
    finished, two steps are made and timed."""
    speeds = [
        point["images_per_second"]
        for run in runs
        if run.row.network == network and run.state == "finished"
        for point in read_curves(run.folder / CURVES)
    ]
    if speeds:
        return config.batch / statistics.median(speeds)
    recipe, plan = find_recipe(config.recipe), find_architecture(network)
    loader = Loader(
        dataset.select("train"), dataset.camera, config.batch, 0, augment=recipe.augment
    )
    device = choose_device(config.device)
    trainer = Trainer(recipe, plan.default_alpha, 0, device, plan)
    trainer.standardise(loader)
    batch, taken = loader.make(0), []
    for _ in range(1 + TIMED_STEPS):
        begin = time.perf_counter()
        float(trainer.step(batch, 0.5).distance)  # waits for the GPU
        taken.append(time.perf_counter() - begin)
    return statistics.median(taken[1:])  # the first step selects kernels


# The page of an ablation: one HTML file that needs no other file.


COLOURS = ("#3b6fd4", "#e07a2e", "#2a9d5c", "#c23b6b")
SINGLE_TASK_COLOUR = "#6a3fb5"  # the paper's purple line
FINAL_SHARE = 0.05
"""Share of the logged points, at the end of a run, over which the final loss is averaged."""
PAPER_DIGITS = {"distance_absolute": 5, "angle_absolute": 5, "accuracy": 2}
"""The columns for which the page also shows the paper's figures, with the number of decimal places
of these figures. The paper does not define its losses exactly."""


def page(
    config: AblationConfig, entries: Sequence[dict[str, Any]], rows: Sequence[Row], runs: list[Run]
) -> str:
    """Return the HTML page. It compares the losses of the finished runs with the paper's losses,
    and shows the errors in metres and radians and the training curves."""
    return render(
        "mtlnet.ablation",
        "ablation.html",
        config=config,
        finished=sum(run.state == "finished" for run in runs),
        runs=len(runs),
        frames=next((entry["frames"] for entry in entries if entry["frames"]), 0),
        learners=lambda columns: [
            (number, entry)
            for number, entry in enumerate(entries)
            if any(entry["row"]["alpha"][column.task] for column in columns)
        ],
        best={column.name: best(entries, column.name) for column in COLUMNS},
        losses=LOSSES,
        trained_on=(
            "squared errors"
            if find_recipe(config.recipe).huber is None
            else "Huber losses of the errors in standard deviations of their targets"
        ),
        errors=ERRORS,
        paper_digits=PAPER_DIGITS,
        alpha_text=_alpha_text,
        charts=[_training_chart(number, rows, runs) for number in range(len(TASK_NAMES))],
    )


def _alpha_text(alpha: Sequence[float]) -> str:
    return ", ".join(f"{weight:g}" for weight in alpha)


def _training_chart(task: int, rows: Sequence[Row], runs: Sequence[Run]) -> Markup:
    """Draw the training loss of one task (an index of `TASK_NAMES`): curves of MTL 1 to 4, and a
    line at the final loss of the network that learned this task alone."""
    name = TASK_NAMES[task]
    multi_task = [row for row in rows if row.network == "mtl" and sum(a > 0 for a in row.alpha) > 1]
    lines, last_step = [], 1.0
    for colour, row in zip(COLOURS, multi_task, strict=False):
        curve = training_curve(runs, row, name)
        if curve is not None:
            steps, losses = curve
            last_step = max(last_step, float(steps[-1]))
            label = f"{row.title} ({_alpha_text(row.alpha)})"
            band = losses.min(0), losses.max(0)
            lines.append(Line("curve", steps, losses.mean(0), label, colour, band))
    single_task = next((row for row in rows if row.name == name), None)
    curve = training_curve(runs, single_task, name) if single_task is not None else None
    if curve is not None:
        lines.append(_final_loss_line(curve[1], last_step, f"{name} alone, final loss"))
    return line_plot(Plot(f"({'abc'[task]}) {name}", lines, "iterations", log=True))


def _final_loss_line(losses: NDArray[np.float64], last_step: float, label: str) -> Line:
    """Return a horizontal line at the mean of the last `FINAL_SHARE` of `losses` (seeds, P)."""
    count = max(1, round(FINAL_SHARE * losses.shape[1]))
    level = np.full(2, losses[:, -count:].mean())
    return Line("level", np.array([0.0, last_step]), level, label, SINGLE_TASK_COLOUR)
