"""`mtlnet train --data DIR --out RUN`: trains a network and publishes it as a model.

The finished model, with a fitted uncertainty head, is written to the folder of the run
(`mtlnet.export.publish`).
"""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from mtlnet.export.publish import Provenance, export_text, publish
from mtlnet.inference.model_card import RUNS, WEIGHTS, ModelCard, ModelError, read_card
from mtlnet.model.network import Network, fold
from mtlnet.model.pretrained import average_with
from mtlnet.training.config import TrainConfig
from mtlnet.training.configure import new_config, newest_run, open_pretrained, resume_config
from mtlnet.training.distributed import read_rank
from mtlnet.training.loop import Report, Stopped, TrainProgress
from mtlnet.training.run import run_training
from mtlnet.training.sources import TrainingData
from mtlnet.training.trainer import Trainer
from mtlnet.uncertainty_fit.head import fit_uncertainty_head
from runtime.files import fsync_path
from trackfeatures.errors import UserError

EXPORT_CHECK_FRAMES = 16
"""Number of frames on which the exported graph is compared with torch."""


def start_training(options: Mapping[str, Any], out: Path | None, *, resume: bool) -> dict[str, Any]:
    """Start or resume a training, and return its result in the form of `mtlnet train --json`: a
    dict with `run`, `iterations`, `seconds`, `model_hash` and `export_check`. In all but the first
    process of a distributed training the dict is empty.

    `options`: the fields of TrainConfig that were given, and `heads`. `out`: folder of the run;
    None for a new folder in `runs/`, or with `resume` for the newest run. Raises UserError.
    """
    resumed = None
    if resume:
        config, resumed = resume_config(out or newest_run(), options)
    elif options.get("change_data"):
        raise UserError("--change-data continues a run on other data; give --resume, too")
    else:
        config = new_config(options, out)
    is_first = read_rank().is_first
    console = Console(stderr=True, quiet=not is_first, markup=False)
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


@contextmanager
def _progress_bar(console: Console) -> Iterator[Report]:
    """Show a progress bar; yields the function that updates it."""
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
    console.print(export_text(card.export_check))
    console.print(f"finished: {run} (serve it with `serve --model {run}`)")


def train(
    config: TrainConfig,
    resumed: dict[str, Any] | None,
    report: Report = lambda _: None,
    *,
    checked: bool = False,
) -> ModelCard:
    """Train a network with the settings of `config` and publish the model in `config.out`; returns
    its card.

    `resumed`: the stored description of the data of the run to resume; None starts a new run.
    `report`: called with the progress every ten steps. `checked`: all images are known to be
    decodable.
    """
    run_training(config, resumed, finish, report, checked=checked)
    return read_card(config.out)


def finish(config: TrainConfig, trainer: Trainer, data: TrainingData) -> None:
    """Fit the uncertainty head and publish the trained network in the run's folder."""
    images = data.spread_images(EXPORT_CHECK_FRAMES)
    provenance = Provenance(
        camera=data.camera,
        alpha=config.alpha,
        recipe=config.recipe,
        iterations=trainer.step_number,
        batch=config.batch,
        seed=config.seed,
        data=data.about,
    )
    network = fold(trainer.network)
    if config.init is not None and config.init_share:
        init = _average_with_init(network, config, config.init, data.about["init"])
        provenance = replace(provenance, data={**data.about, "init": init})
    uncertainty = fit_uncertainty_head(
        network, data.frames, data.held_out, config.seed, data.camera
    )
    publish(network, config.out, images, provenance, uncertainty=uncertainty)
    link_latest(config.out)


def _average_with_init(
    network: Network, config: TrainConfig, name: str, init: dict[str, Any]
) -> dict[str, Any]:
    """Average the weights of the trained `network` with those of the model called `name`, from
    which the training started, and return the card's description of this model.

    `init`: this description as of the start. Raises ModelError when the model has been replaced.
    """
    run, card = open_pretrained(name)
    if card.model_hash != init["model_hash"]:
        raise ModelError(
            f"{run} no longer holds the model that {config.out} was started from, so the mean with "
            "it (--init-share) is not possible; restore the model, or finish without it: "
            f"`mtlnet train --out {config.out} --resume --init-share 0`"
        )
    average_with(network, run / WEIGHTS, config.init_share)
    return {**init, "share": config.init_share}


def link_latest(run: Path) -> None:
    """Make `runs/latest` a link to the folder `run`; does nothing if this folder is not in
    `runs/`."""
    if run.resolve().parent != RUNS.resolve():
        return
    link = RUNS / "latest.partial"
    link.unlink(missing_ok=True)
    link.symlink_to(run.resolve().name)
    link.replace(RUNS / "latest")
    fsync_path(RUNS)
