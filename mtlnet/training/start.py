"""Starting or resuming a training run from the command line, with a progress bar."""

import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from mtlnet.inference.model_card import RUNS, ModelError
from mtlnet.model.architecture import find_architecture
from mtlnet.training.config import CONFIG, TrainConfig, resume_config
from mtlnet.training.distributed import find_part
from mtlnet.training.fine_tune import open_init
from mtlnet.training.loop import Progress as Point
from mtlnet.training.loop import Stopped
from mtlnet.training.loss import parse_alpha
from mtlnet.training.recipes import find_recipe
from mtlnet.training.run import train
from trackfeatures.errors import UserError

DATASET = Path("datasets/default")


def start_training(
    options: dict[str, Any], alpha: str | None, out: Path | None, *, resume: bool
) -> dict[str, Any]:
    """Train; what `mtlnet train --json` prints. `options`: what was given of a TrainConfig."""
    if alpha is not None:
        options["alpha"] = parse_alpha(alpha)
    resumed = None
    if resume:
        config, resumed = resume_config(out or newest_run(), options)
    else:
        if out is None and find_part().world > 1:
            raise UserError("give --out: several processes must agree on the run's folder")
        usual: dict[str, Any] = {"recipe": "fast"}
        if "init" in options:
            run, card = open_init(options["init"])
            same = {"network": card.network, "alpha": card.alpha, "recipe": "tune"}
            usual, options["init"] = same, str(run)
        else:
            usual["alpha"] = find_architecture(options.get("network", "mtl")).default_alpha
        recipe = find_recipe(options.get("recipe", usual["recipe"])).name
        folder = out or RUNS / f"{time.strftime('%Y%m%d-%H%M%S')}-{recipe}"
        config = TrainConfig(**{"data": DATASET, "out": folder, **usual, **options})
    console = Console(stderr=True, quiet=not find_part().first)
    console.print(
        f"training {config.network} in {config.out} on {config.data}, recipe {config.recipe}"
    )
    began = time.perf_counter()
    with _bar(console) as bar:
        task = bar.add_task("", total=1.0, text="reading labels", left="")
        try:
            card = train(config, resumed, lambda point: _show(bar, task, point))
        except Stopped as stopped:
            bar.stop()
            console.print(
                f"stopped; the state is in {stopped}; go on with "
                f"`mtlnet train --out {config.out} --resume`"
            )
            raise
    if not find_part().first:
        return {}  # the first process says it
    differences = {k: v for k, v in card.export_check.items() if k != "frames"}
    console.print(
        f"exported and checked against torch on {card.export_check['frames']:.0f} frames, largest "
        f"difference: {', '.join(f'{name} {value:.2g}' for name, value in differences.items())}"
    )
    console.print(f"finished: {config.out} (serve it with `serve --model {config.out}`)")
    return {
        "run": str(config.out),
        "iterations": card.iterations,
        "seconds": round(time.perf_counter() - began, 3),
        "model_hash": card.model_hash,
        "export_check": card.export_check,
    }


def newest_run() -> Path:
    """The run in `runs/` that was started last."""
    runs = [p.parent for p in RUNS.glob(f"*/{CONFIG}") if not p.parent.is_symlink()]
    if not runs:
        raise ModelError(f"there is no run in {RUNS}/ to resume; give its folder with --out")
    return max(runs, key=lambda run: (run / CONFIG).stat().st_mtime)


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.percentage:>3.0f} %"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[text]}"),
        TextColumn("{task.fields[left]}"),
        console=console,
        refresh_per_second=2,
    )


def _show(bar: Progress, task: TaskID, point: Point) -> None:
    distance, angle, kind, _ = point.losses.tolist()
    left = ""
    if point.fraction > 0.01:
        seconds = point.elapsed_s * (1 / point.fraction - 1)
        left = f"{seconds // 60:.0f} min {seconds % 60:02.0f} s left"
    bar.update(
        task,
        completed=point.fraction,
        text=f"step {point.step}  distance {distance:.4f}  angle {angle:.5f}  type {kind:.3f}  "
        f"{point.images_per_second:.0f} images/s",
        left=left,
    )
