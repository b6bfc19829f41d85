"""Trains a network by a configuration, in the folder of the run.

A run stopped with Ctrl-C leaves a checkpoint, from which `--resume` continues. A run with `--init`
starts from a finished model and keeps that model's camera. The caller passes the function that
turns the trained network into a finished model (`mtlnet.train`).
"""

import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from datagen.recording import Frames
from mtlnet.architecture import find_architecture
from mtlnet.data.gpu_cache import cache_if_it_fits
from mtlnet.data.loader import Loader
from mtlnet.data.road_ahead import RoadAhead, hard_frame_repeats
from mtlnet.inference.model_card import WEIGHTS, ModelCard
from mtlnet.model.pretrained import load_pretrained
from mtlnet.training.checkpoint import list_checkpoints, load_checkpoint
from mtlnet.training.config import CONFIG, TrainConfig
from mtlnet.training.configure import open_pretrained, read_config, write_config
from mtlnet.training.device import choose_device, configure_cpu, subnormals_as_zero
from mtlnet.training.distributed import Rank, barrier, process_group, read_rank
from mtlnet.training.loop import Report, train_loop
from mtlnet.training.losses.task_weighting import TaskWeighting
from mtlnet.training.recipes import Recipe, find_recipe
from mtlnet.training.sources import (
    TrainingData,
    continue_from_model,
    open_training_data,
    resume_data,
)
from mtlnet.training.trainer import Trainer
from runtime.files import locked_folder, unfinished_path
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

PRETRAINED_FRAMES = 128
"""Number of training frames on which the batch statistics are measured when batch normalisation is
restored in a finished model."""

Finish = Callable[[TrainConfig, Trainer, TrainingData], None]
"""A function that writes the finished model to the run's folder, called in the first process."""


def run_training(
    config: TrainConfig,
    resumed: dict[str, Any] | None,
    finish: Finish,
    report: Report = lambda _: None,
    *,
    checked: bool = False,
) -> None:
    """Train with the configuration `config` in the folder `config.out`, then call `finish`.

    `resumed`: the stored description of the data of the run to resume; None starts a new run.
    `report`: called with the progress every ten steps. `checked`: the caller has decoded all images
    without an error. Raises UserError for unusable data, an existing folder, a lack of memory or
    disk space, and a run that another process is training; raises Stopped after Ctrl-C.
    """
    find_recipe(config.recipe)  # raises when there is none
    rank = read_rank()
    device = choose_device(config.device, rank)
    try:
        with process_group(rank, device, config.batch), subnormals_as_zero():
            data, init = _open_data(config, resumed, rank, checked=checked)
            configure_cpu(config.threads, rank)
            with locked_folder(config.out) if rank.is_first else nullcontext():
                trainer, loader = prepare(config, data, init, device, rank)
                _train(config, resumed, finish, report, data, trainer, loader)
    except torch.OutOfMemoryError as error:
        raise UserError(
            f"the memory of {device} is used up; give a smaller --batch than {config.batch}, or "
            "train with --device cpu"
        ) from error


def _open_data(
    config: TrainConfig, resumed: dict[str, Any] | None, rank: Rank, *, checked: bool
) -> tuple[TrainingData, tuple[Path, ModelCard] | None]:
    """The data of a run and the model that it starts from; makes the folder of a new run."""
    if resumed is None and rank.is_first:
        require_new(config.out)
    kept = None if resumed is None or config.init_share else _kept_camera(config, resumed)
    init = None if config.init is None or kept is not None else open_pretrained(config.init)
    data = open_training_data(config, init[1] if init else None, kept, checked=checked)
    if resumed is not None and list_checkpoints(config.out) and not config.init_share:
        init = None  # the checkpoint has replaced the weights of this model
    if resumed is not None:
        data = resume_data(config, data, resumed, init[1] if init else None)
    elif init is not None:
        data = continue_from_model(data, init[1])
    if resumed is None and rank.is_first:
        create_run(config, find_recipe(config.recipe), data.about)
    return data, init


def _kept_camera(config: TrainConfig, resumed: dict[str, Any]) -> CameraParameters | None:
    """The camera of a resumed run that no longer needs the model of `config.init`, because a
    checkpoint has replaced its weights.

    None for a run without that model or without a checkpoint, and for a run of an earlier version,
    which has not stored its camera.
    """
    if config.init is None or "camera" not in resumed or not list_checkpoints(config.out):
        return None
    return CameraParameters(**resumed["camera"])


def _train(
    config: TrainConfig,
    resumed: dict[str, Any] | None,
    finish: Finish,
    report: Report,
    data: TrainingData,
    trainer: Trainer,
    loader: Loader,
) -> None:
    """Train, from the newest checkpoint if the run is resumed, then call `finish`."""
    is_first = read_rank().is_first
    checkpoints = list_checkpoints(config.out) if resumed is not None else []
    elapsed_s = load_checkpoint(checkpoints[-1], trainer) if checkpoints else 0.0
    barrier()  # the first process writes nothing until all processes have read the checkpoint
    if resumed is not None and is_first and read_config(config.out)[0] != config:
        # Otherwise a run that is stopped again would continue with its first options.
        write_config(config, find_recipe(config.recipe), data.about)
    try:
        first_row = trainer.network.architecture.first_row
        batches = cache_if_it_fits(loader, trainer.device, first_row=first_row)
        train_loop(config, trainer, batches, elapsed_s, report)
        if is_first:
            finish(config, trainer, data)
        barrier()
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        raise UserError(
            f"the run in {config.out} broke off: {error.strerror or error}{where}; repair that, "
            f"then continue with `mtlnet train --out {config.out} --resume`"
        ) from error


def require_new(out: Path) -> None:
    """Raise UserError when the folder of a new run exists and is not empty.

    A folder that contains only an unfinished `config.json` is accepted like an empty folder. Both
    can remain when a training is killed at its start.
    """
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
        shutil.rmtree(config.out)  # so that the same command works once the disk has space
        raise


def prepare(
    config: TrainConfig,
    data: TrainingData,
    init: tuple[Path, ModelCard] | None,
    device: torch.device,
    rank: Rank,
) -> tuple[Trainer, Loader]:
    """Make the trainer, before its first step, and the loader of its batches.

    `init`: folder and card of the model whose weights the network gets. None: new weights, which
    the caller may replace by the weights of a checkpoint.
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
        load_pretrained(trainer.network, run / WEIGHTS, images, card.network)
    return trainer, loader


def road_ahead(data: TrainingData, device: torch.device) -> RoadAhead | None:
    """Open the labels of the road ahead for recorded rounds; None for a user's own pictures.

    For training on a GPU the labels of all frames are read in advance.
    """
    if not isinstance(data.frames, Frames):
        return None
    return RoadAhead(data.frames, data.camera, keep=device.type != "cpu")
