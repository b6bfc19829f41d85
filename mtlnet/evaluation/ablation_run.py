"""`mtlnet ablate --out FOLDER --iterations N --seeds 1,2,3`: the table of the paper, made anew.

The folder holds `runs/ROW-seedS`, `ablation.json` and `ablation.html`, written again after every
finished run: the page can be read while the ablation goes on.
"""

import json
import os
import statistics
import time
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from rich.console import Console

from datagen.recording import Dataset
from mtlnet.data.loader import Loader
from mtlnet.data.sources import open_training_dataset, require_all_decodable
from mtlnet.evaluation.ablation import (
    ERRORS,
    LOSSES,
    PAPER_COLUMNS,
    AblationConfig,
    Row,
    Run,
    best,
    carry_out,
    plan_runs,
    require_same_settings,
    table,
    training_curve,
)
from mtlnet.evaluation.evaluate import evaluate
from mtlnet.inference.curves import CURVES, read_curves
from mtlnet.inference.engine import load_engine
from mtlnet.model.architecture import find_architecture
from mtlnet.training.config import TrainConfig
from mtlnet.training.loop import Progress
from mtlnet.training.loss import TASKS
from mtlnet.training.recipes import find_recipe
from mtlnet.training.run import train
from mtlnet.training.trainer import Trainer, choose_device
from runtime.files import atomic_write
from runtime.svg_charts import Line, Numbers, Plot, plot, style
from trackfeatures.errors import UserError

TIMED_STEPS = 2
SAY_SECONDS = 30.0


def ablate(config: AblationConfig, rows: Sequence[Row], *, dry_run: bool = False) -> dict[str, Any]:
    """Carry an ablation out, or only say what it would do; what `--json` prints.

    Raises UserError when the folder was made with other settings, or a run fails.
    """
    console = Console(stderr=True)
    dataset = open_training_dataset(config.data)
    dataset.select(config.split)  # raises where there are no such rounds
    runs = plan_runs(config, rows)
    if dry_run:
        return _tell_plan(config, runs, dataset, console)
    require_all_decodable(dataset, ("train", config.split))  # once for all runs
    require_same_settings(config, dataset.content_hash)
    for number, run in enumerate(carry_out(config, runs, _trainer(console), _judge), 1):
        console.print(f"{number} of {len(runs)}: {run.folder} is finished")
        write_result(config, rows, runs)
    console.print(f"the table: {config.out / 'ablation.html'}")
    return write_result(config, rows, runs)


def write_result(config: AblationConfig, rows: Sequence[Row], runs: list[Run]) -> dict[str, Any]:
    """Write `ablation.json` and `ablation.html` of what is finished; the content of the former."""
    entries = table(rows, runs)
    result = {**config.fixed(), "data": str(config.data), "rows": entries}
    atomic_write(
        config.out / "ablation.json", (json.dumps(result, indent=1) + "\n").encode(), fsync=True
    )
    atomic_write(
        config.out / "ablation.html", page(config, entries, rows, runs).encode(), fsync=True
    )
    return result


def _trainer(console: Console) -> Any:
    """`train` that says how far it is now and then."""

    def work(config: TrainConfig, resumed: dict[str, Any] | None) -> None:
        said = time.perf_counter()
        console.print(f"training {config.out}")

        def report(point: Progress) -> None:
            nonlocal said
            if time.perf_counter() - said > SAY_SECONDS:
                said = time.perf_counter()
                console.print(
                    f"  step {point.step} of {config.iterations}, "
                    f"{point.images_per_second:.0f} images/s"
                )

        try:
            train(config, resumed, report, checked=True)
        except UserError as error:
            raise UserError(f"the run in {config.out} failed: {error}") from error

    return work


def _judge(run: Path, config: AblationConfig) -> dict[str, Any]:
    """The evaluation of a finished run, in float32."""
    engines = [load_engine(run, "openvino", "f32") for _ in range(os.cpu_count() or 1)]
    return evaluate(engines, config.data, config.split, every=config.every)


def _tell_plan(
    config: AblationConfig, runs: Sequence[Run], dataset: Dataset, console: Console
) -> dict[str, Any]:
    """The plan with the seconds that each run still needs."""
    seconds = {
        name: step_seconds(config, name, runs, dataset)
        for name in dict.fromkeys(run.row.network for run in runs)
    }
    plan = []
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
    total = sum(entry["seconds"] for entry in plan)  # type: ignore[misc]  # ints
    console.print(f"{len(runs)} runs of {config.iterations} steps, about {total / 3600:.1f} h left")
    return {"runs": plan, "seconds": total, "step_seconds": seconds}


def step_seconds(
    config: AblationConfig, network: str, runs: Sequence[Run], dataset: Dataset
) -> float:
    """Seconds a step: as finished runs of the network took, else of a few steps taken now."""
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
        float(trainer.step(batch, 0.5).distance)  # waits for a GPU
        taken.append(time.perf_counter() - begin)
    return statistics.median(taken[1:])  # the first one chooses kernels


# The page of an ablation: one HTML file that needs nothing beside it.


COLOURS = ("#3b6fd4", "#e07a2e", "#2a9d5c", "#c23b6b")
SINGLE = "#6a3fb5"  # the paper's purple line
END = 0.05  # the share of a run over which its final loss is averaged
Column = tuple[str, str, str, int, int]
PAPER_DIGITS = {"distance_absolute": 5, "angle_absolute": 5, "accuracy": 2}
NONE = '<td class="none">&ndash;'


def page(
    config: AblationConfig, entries: Sequence[dict[str, Any]], rows: Sequence[Row], runs: list[Run]
) -> str:
    """HTML of the table beside the paper's, every marking, and the training curves."""
    finished = sum(run.state == "finished" for run in runs)
    frames = next((entry["frames"] for entry in entries if entry["frames"]), 0)
    template = Template(
        files("mtlnet.evaluation").joinpath("ablation.html").read_text(encoding="utf-8")
    )
    return template.substitute(
        chart_style=style(),
        summary=f"{finished} of {len(runs)} runs of {config.iterations:,} iterations each, judged "
        f"on {frames:,} {escape(config.split)} frames.",
        settings=f"Data <code>{escape(str(config.data))}</code>, recipe {escape(config.recipe)}, "
        f"batches of {config.batch}, seeds {', '.join(map(str, config.seeds))}.",
        losses=_table(entries, LOSSES),
        errors=_table(entries, ERRORS),
        charts="".join(_chart(number, rows, runs) for number in range(len(TASKS))),
    )


def _table(entries: Sequence[dict[str, Any]], columns: Sequence[Column]) -> str:
    """Rows that learn something of the `columns`, the paper's figures beside ours."""
    winners = {name: best(entries, name) for name, *_ in columns}
    heads = "".join(
        f"<th>{title}<br><small>{unit}</small>"
        + ('<th class="paper">paper' if name in PAPER_COLUMNS else "")
        for name, title, unit, _, _ in columns
    )
    body = []
    for i, entry in enumerate(entries):
        if all(entry["row"]["alpha"][task] == 0 for *_, task in columns):
            continue
        cells = []
        for name, _, _, digits, _ in columns:
            scale = 100.0 if name == "accuracy" else 1.0
            cells.append(_cell(entry["figures"][name], digits, scale, bold=winners[name] == i))
            if name in PAPER_COLUMNS:
                value = entry["row"]["paper"][PAPER_COLUMNS.index(name)]
                cells.append(
                    '<td class="paper">'
                    + ("" if value is None else f"{value * scale:.{PAPER_DIGITS[name]}f}")
                )
        part = ' class="part"' if entry["row"]["name"] in ("mtl-1", "deepdriving") else ""
        body.append(f"<tr{part}>{_title(entry)}{''.join(cells)}")
    return f"<table><thead><tr><th>row<th>alpha{heads}<tbody>{''.join(body)}</table>"


def _title(entry: dict[str, Any]) -> str:
    alpha = ", ".join(f"{weight:g}" for weight in entry["row"]["alpha"])
    return f"<th>{escape(entry['row']['title'])}<td>{alpha}"


def _cell(value: dict[str, Any] | None, digits: int, scale: float, *, bold: bool = False) -> str:
    if value is None:
        return NONE
    spread = ""
    if value["std"] is not None:
        spread = f" <small>&plusmn; {value['std'] * scale:.{digits}f}</small>"
    mark = ' class="best"' if bold else ""
    return f"<td{mark}>{value['mean'] * scale:.{digits}f}{spread}"


def _chart(task: int, rows: Sequence[Row], runs: Sequence[Run]) -> str:
    """The training loss of one task: MTL 1 to 4, and where the task ends when learned alone."""
    name = TASKS[task]
    together = [row for row in rows if row.network == "mtl" and sum(a > 0 for a in row.alpha) > 1]
    lines, last = [], 1.0
    for colour, row in zip(COLOURS, together, strict=False):
        curve = training_curve(runs, row, name)
        if curve is not None:
            steps, losses = curve
            last = max(last, float(steps[-1]))
            alpha = ", ".join(f"{weight:g}" for weight in row.alpha)
            label = f"{row.title} ({alpha})"
            band = losses.min(0), losses.max(0)
            lines.append(Line("curve", steps, losses.mean(0), label, colour, band))
    alone = next((row for row in rows if row.name == name), None)
    curve = training_curve(runs, alone, name) if alone is not None else None
    if curve is not None:
        lines.append(_level(curve[1], last, f"{name} alone, at the end"))
    return plot(Plot(f"({'abc'[task]}) {name}", lines, "iterations", log=True))


def _level(losses: Numbers, last: float, label: str) -> Line:
    """The mean over the end of losses (seeds, P), as a line up to x = `last`."""
    end = max(1, round(END * losses.shape[1]))
    level = np.full(2, losses[:, -end:].mean())
    return Line("level", np.array([0.0, last]), level, label, SINGLE)
