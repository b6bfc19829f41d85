"""Starts or resumes a training run for `mtlnet train`, with a progress bar on stderr."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from mtlnet.inference.model_card import RUNS, ModelCard, ModelError
from mtlnet.model.architecture import find_architecture
from mtlnet.training.config import CONFIG, TrainConfig, resume_config
from mtlnet.training.distributed import read_rank
from mtlnet.training.loop import Report, Stopped, TrainProgress
from mtlnet.training.recipes import find_recipe
from mtlnet.training.run import open_pretrained, train
from trackfeatures.errors import UserError

DATASET = Path("datasets/default")


def start_training(options: Mapping[str, Any], out: Path | None, *, resume: bool) -> dict[str, Any]:
    """Train, and return what `mtlnet train --json` prints; {} in all but the first process.

    `options`: the fields of TrainConfig that were given. Raises UserError.
    """
    resumed = None
    if resume:
        config, resumed = resume_config(out or newest_run(), options)
    else:
        config = new_config(options, out)
    is_first = read_rank().is_first
    console = Console(stderr=True, quiet=not is_first)
    console.print(
        f"training {config.network} in {config.out} on {config.data}, recipe {config.recipe}"
    )
    begin = time.perf_counter()
    try:
        with _progress_bar(console) as report:
            card = train(config, resumed, report)
    except Stopped as stopped:
        console.print(
            f"stopped; the checkpoint is {stopped}; continue with "
            f"`mtlnet train --out {config.out} --resume`"
        )
        raise
    if not is_first:
        return {}
    _print_result(console, config.out, card)
    return {
        "run": str(config.out),
        "iterations": card.iterations,
        "seconds": round(time.perf_counter() - begin, 3),
        "model_hash": card.model_hash,
        "export_check": card.export_check,
    }


def new_config(options: Mapping[str, Any], out: Path | None) -> TrainConfig:
    """The configuration of a new run; defaults are those of the network or of the `init` model."""
    if out is None and read_rank().world_size > 1:
        raise UserError("give --out: several processes must use the same folder for the run")
    values: dict[str, Any] = {"data": DATASET, "recipe": "fast"}
    if "init" in options:
        run, card = open_pretrained(options["init"])
        values.update(network=card.network, alpha=card.alpha, recipe="tune")
        options = {**options, "init": str(run)}
    else:
        values["alpha"] = find_architecture(options.get("network", "mtl")).default_alpha
    values.update(options)
    recipe = find_recipe(values["recipe"]).name
    folder = out or RUNS / f"{time.strftime('%Y%m%d-%H%M%S')}-{recipe}"
    return TrainConfig(out=folder, **values)


def newest_run() -> Path:
    """The run in `runs/` that was started last; ModelError when there is none."""
    runs = [p.parent for p in RUNS.glob(f"*/{CONFIG}") if not p.parent.is_symlink()]
    if not runs:
        raise ModelError(f"there is no run in {RUNS}/ to resume; give its folder with --out")
    return max(runs, key=lambda run: (run / CONFIG).stat().st_mtime)


@contextmanager
def _progress_bar(console: Console) -> Iterator[Report]:
    """A progress bar within the context; yields the function that updates it."""
    columns = (
        TextColumn("{task.percentage:>3.0f} %"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[text]}"),
        TextColumn("{task.fields[left]}"),
    )
    with Progress(*columns, console=console, refresh_per_second=2) as bar:
        task = bar.add_task("", total=1.0, text="reading labels", left="")

        def update(progress: TrainProgress) -> None:
            text = _progress_text(progress)
            bar.update(task, completed=progress.fraction, text=text, left=_time_left(progress))

        yield update


def _progress_text(progress: TrainProgress) -> str:
    distance, angle, heading, _ = progress.losses.tolist()
    return (
        f"step {progress.step}  distance {distance:.4f}  angle {angle:.5f}  heading {heading:.3f}  "
        f"{progress.images_per_second:.0f} images/s"
    )


def _time_left(progress: TrainProgress) -> str:
    if progress.fraction <= 0.01:
        return ""
    seconds = progress.elapsed_s * (1 / progress.fraction - 1)
    return f"{seconds // 60:.0f} min {seconds % 60:02.0f} s left"


def _print_result(console: Console, run: Path, card: ModelCard) -> None:
    check = card.export_check
    differences = [f"{name} {value:.2g}" for name, value in check.items() if name != "frames"]
    console.print(
        f"exported and compared with torch on {check['frames']:.0f} frames, largest difference: "
        f"{', '.join(differences)}"
    )
    console.print(f"finished: {run} (serve it with `serve --model {run}`)")
