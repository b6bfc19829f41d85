"""A training run from its configuration to a published model: `mtlnet train --data DIR --out RUN`.

Ends with the finished model in the run's folder (see `mtlnet.export.publish`). Stopped by Ctrl-C it
leaves a checkpoint, from which `--resume` continues. With `--init` it starts from a finished model,
which keeps its camera.
"""

import os
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from datagen.recording import Frames
from mtlnet.data.gpu_cache import cache_if_it_fits
from mtlnet.data.loader import Loader
from mtlnet.data.road_ahead import RoadAhead, hard_frame_repeats
from mtlnet.data.sources import (
    TrainingData,
    continue_from_model,
    open_training_data,
    resume_data,
)
from mtlnet.export.publish import Provenance, export_text, publish
from mtlnet.inference.model_card import RUNS, ModelCard, read_card
from mtlnet.model.architecture import find_architecture
from mtlnet.model.network import fold
from mtlnet.model.pretrained import load_pretrained
from mtlnet.training.checkpoint import list_checkpoints, load_checkpoint
from mtlnet.training.config import (
    CONFIG,
    TrainConfig,
    new_config,
    newest_run,
    open_pretrained,
    read_config,
    resume_config,
    write_config,
)
from mtlnet.training.distributed import Rank, barrier, process_group, read_rank
from mtlnet.training.loop import Report, Stopped, TrainProgress, train_loop
from mtlnet.training.recipes import Recipe, find_recipe
from mtlnet.training.task_weighting import TaskWeighting
from mtlnet.training.trainer import Trainer, choose_device, keep_freed_memory
from mtlnet.uncertainty_fit.head import fit_uncertainty_head
from runtime.files import fsync_path, locked_folder, unfinished_path
from trackfeatures.errors import UserError

EXPORT_CHECK_FRAMES = 16
"""Frames on which the exported graph is compared with torch."""
PRETRAINED_FRAMES = 128
"""Frames that measure the statistics of batch normalisation for a finished model."""


def start_training(options: Mapping[str, Any], out: Path | None, *, resume: bool) -> dict[str, Any]:
    """Train, and return what `mtlnet train --json` prints; {} in all but the first process.

    `options`: the fields of TrainConfig that were given. Raises UserError.
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
    console.print(export_text(card.export_check))
    console.print(f"finished: {run} (serve it with `serve --model {run}`)")


def train(
    config: TrainConfig,
    resumed: dict[str, Any] | None,
    report: Report = lambda _: None,
    *,
    checked: bool = False,
) -> ModelCard:
    """Train by `config` and publish the model in `config.out`.

    `resumed`: the description of the data stored by the run to resume; None starts a new run.
    `checked`: all images are known to be decodable. Raises UserError (data, an existing folder,
    memory, disk, a run that is being trained), Stopped after Ctrl-C.
    """
    find_recipe(config.recipe)  # raises when there is none
    rank = read_rank()
    device = choose_device(config.device, rank)
    try:
        with process_group(rank, device, config.batch), subnormals_as_zero():
            return _train(config, resumed, report, device, rank, checked=checked)
    except torch.OutOfMemoryError as error:
        raise UserError(
            f"the memory of {device} is used up; give a smaller --batch than {config.batch}, or "
            "train with --device cpu"
        ) from error


def _train(
    config: TrainConfig,
    resumed: dict[str, Any] | None,
    report: Report,
    device: torch.device,
    rank: Rank,
    *,
    checked: bool,
) -> ModelCard:
    if resumed is None and rank.is_first:
        require_new(config.out)
    init = None if config.init is None else open_pretrained(config.init)
    data = open_training_data(config, init[1] if init else None, checked=checked)
    if resumed is not None and list_checkpoints(config.out):
        init = None  # its weights have been replaced since
    if resumed is not None:
        data = resume_data(config, data, resumed, init[1] if init else None)
    elif init is not None:
        data = continue_from_model(data, init[1])
    if resumed is None and rank.is_first:
        create_run(config, find_recipe(config.recipe), data.about)
    configure_cpu(config, rank)
    with locked_folder(config.out) if rank.is_first else nullcontext():
        trainer, loader = prepare(config, data, init, device, rank)
        return _train_and_publish(config, resumed, report, data, trainer, loader)


def _train_and_publish(
    config: TrainConfig,
    resumed: dict[str, Any] | None,
    report: Report,
    data: TrainingData,
    trainer: Trainer,
    loader: Loader,
) -> ModelCard:
    """Train in the folder of the run, from its newest checkpoint if it is resumed."""
    is_first = read_rank().is_first
    checkpoints = list_checkpoints(config.out) if resumed is not None else []
    elapsed_s = load_checkpoint(checkpoints[-1], trainer) if checkpoints else 0.0
    barrier()  # the first process writes nothing until all have read the checkpoint
    if resumed is not None and is_first and read_config(config.out)[0] != config:
        # Else a run that is stopped again would go on with the options it was started with.
        write_config(config, find_recipe(config.recipe), data.about)
    try:
        first_row = trainer.network.architecture.first_row
        batches = cache_if_it_fits(loader, trainer.device, first_row=first_row)
        train_loop(config, trainer, batches, elapsed_s, report)
        if is_first:
            finish(config, trainer, data)
        barrier()
        return read_card(config.out)
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        raise UserError(
            f"the run in {config.out} broke off: {error.strerror or error}{where}; repair that, "
            f"then continue with `mtlnet train --out {config.out} --resume`"
        ) from error


def require_new(out: Path) -> None:
    """Raise UserError when the folder of a new run exists; a kill may have left it empty."""
    empty = out.is_dir() and {*out.iterdir()} <= {unfinished_path(out / CONFIG)}
    if out.exists() and not empty:
        raise UserError(
            f"{out} already exists; continue that run with --resume, or choose another --out"
        )


def create_run(config: TrainConfig, recipe: Recipe, data: dict[str, Any]) -> None:
    """Make the folder of a new run with its `config.json`."""
    config.out.mkdir(parents=True, exist_ok=True)
    try:
        write_config(config, recipe, data)
    except OSError:
        shutil.rmtree(config.out)  # so that the same command works once the disk has room
        raise


def configure_cpu(config: TrainConfig, rank: Rank) -> None:
    """Divide this machine's cores among its processes, and keep freed memory."""
    torch.set_num_threads(config.threads or max((os.cpu_count() or 1) // rank.local_world_size, 1))
    cv2.setNumThreads(1)  # the images are small: a second thread pool would compete with torch's
    keep_freed_memory()


@contextmanager
def subnormals_as_zero() -> Iterator[None]:
    """Within its context, numbers under 1e-38 count as 0 in this thread and those it starts.

    Units that seldom learn have momenta so small after a few thousand steps. Each takes the
    processor some 100 cycles; a step then took 1.9 times as long.
    """
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


def prepare(
    config: TrainConfig,
    data: TrainingData,
    init: tuple[Path, ModelCard] | None,
    device: torch.device,
    rank: Rank,
) -> tuple[Trainer, Loader]:
    """The trainer before its first step, with the weights of the model `init`, and the batches.

    `init` None: new weights, or those of a checkpoint, which is yet to be read.
    """
    recipe = find_recipe(config.recipe)
    recipe = replace(recipe, learning_rate=recipe.learning_rate * config.rate_factor)
    steps_per_epoch = max(len(data.frames) // config.batch, 1)
    trainer = Trainer(
        recipe,
        config.alpha,
        config.seed,
        device,
        find_architecture(config.network),
        task_weighting=TaskWeighting(config.balance, config.alpha, device, steps_per_epoch),
        rank=rank,
        folded=config.init is not None and not recipe.batch_norm,
    )
    loader = Loader(
        data.frames,
        data.camera,
        config.batch,
        config.seed,
        augment=recipe.augment,
        part=(rank.index, rank.world_size),
        ahead=None if trainer.network.auxiliary is None else road_ahead(data, device),
        repeats=hard_frame_repeats(data.frames, recipe.hard_repeats),
    )
    trainer.standardise(loader, fine_tune=config.init is not None)
    if init is not None:
        run, card = init
        images = data.spread_images(PRETRAINED_FRAMES) if recipe.batch_norm else None
        load_pretrained(trainer.network, run, images, card.network)
    return trainer, loader


def road_ahead(data: TrainingData, device: torch.device) -> RoadAhead | None:
    """Labels of the road ahead, if the data are recorded rounds; for a GPU read in advance."""
    if not isinstance(data.frames, Frames):
        return None
    return RoadAhead(data.frames, data.camera, keep=device.type != "cpu")


def finish(config: TrainConfig, trainer: Trainer, data: TrainingData) -> ModelCard:
    """Publish the trained network in the run's folder."""
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
    uncertainty = fit_uncertainty_head(
        fold(trainer.network), data.frames, data.held_out, config.seed, data.camera
    )
    card = publish(trainer.network, config.out, images, provenance, uncertainty=uncertainty)
    link_latest(config.out)
    return card


def link_latest(run: Path) -> None:
    """Point `runs/latest` to `run` when it lies in `runs/`."""
    if run.resolve().parent != RUNS.resolve():
        return
    link = RUNS / "latest.partial"
    link.unlink(missing_ok=True)
    link.symlink_to(run.resolve().name)
    link.replace(RUNS / "latest")
    fsync_path(RUNS)
