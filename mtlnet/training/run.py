"""Training a model from a dataset: `mtlnet train --data DIR --out RUN --alpha 0.3,0.2,0.5`.

Ends with the finished model in the run's folder (see `mtlnet.export.publish`); stopped by Ctrl-C it
leaves a checkpoint to go on from with `--resume`.
"""

import os
import shutil
from pathlib import Path
from typing import Any

import cv2
import torch

from mtlnet.data.gpu_cache import cache_if_it_fits
from mtlnet.data.loader import Loader
from mtlnet.data.sources import TrainingData, open_training_data, require_same_data
from mtlnet.inference.model_card import ModelCard, read_card
from mtlnet.model.architecture import find_architecture
from mtlnet.training.checkpoint import list_checkpoints, load_checkpoint
from mtlnet.training.config import TrainConfig, write_config
from mtlnet.training.distributed import Part, find_part, joined, wait
from mtlnet.training.fine_tune import TUNED_LEAST, open_init, take_weights
from mtlnet.training.finish import finish
from mtlnet.training.loop import Report, learn
from mtlnet.training.recipes import Recipe, find_recipe
from mtlnet.training.trainer import Trainer, choose_device, keep_freed_memory
from trackfeatures.errors import UserError


def train(
    config: TrainConfig,
    resumed: dict[str, Any] | None,
    report: Report = lambda _: None,
    *,
    checked: bool = False,
) -> ModelCard:
    """Train by `config` and publish the model in `config.out`.

    `resumed`: the description of the data as the run was started with, to go on with it; None
    starts a new run. `checked`: the images are known to be decodable. Raises UserError (data, an
    existing folder), Stopped after Ctrl-C.
    """
    find_recipe(config.recipe)  # raises where there is none
    part = find_part()
    device = choose_device(config.device, part)
    try:
        with joined(part, device, config.batch):
            return _train(config, resumed, report, device, part, checked=checked)
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
    part: Part,
    *,
    checked: bool,
) -> ModelCard:
    if resumed is None and part.first:
        require_new(config.out)
    init = None if config.init is None else open_init(config.init)
    material = open_training_data(config, init[1] if init else None, checked=checked)
    if resumed is None and part.first:
        create_run(config, find_recipe(config.recipe), material.about)
    if resumed is not None:
        require_same_data(config, resumed, material.about)
    settle(config, part)
    trainer, loader = prepare(config, material, init[0] if init else None, device, part)
    checkpoints = list_checkpoints(config.out) if resumed is not None else []
    elapsed_s = load_checkpoint(checkpoints[-1], trainer) if checkpoints else 0.0
    wait()  # until all have read it, the first one writes nothing
    try:
        batches = cache_if_it_fits(loader, device)
        learn(config, trainer, batches, elapsed_s, report, part)
        if part.first:
            finish(config, trainer, material)
        wait()
        return read_card(config.out)
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        raise UserError(
            f"the run in {config.out} broke off: {error.strerror or error}{where}; mend that, then "
            f"go on with `mtlnet train --out {config.out} --resume`"
        ) from error


def settle(config: TrainConfig, part: Part) -> None:
    """Share out this machine's cores, and keep memory that is used again."""
    torch.set_num_threads(config.threads or max((os.cpu_count() or 1) // part.local, 1))
    cv2.setNumThreads(1)  # the loader's images are small: a second pool would only fight torch's
    keep_freed_memory()


def prepare(
    config: TrainConfig, material: TrainingData, init: Path | None, device: torch.device, part: Part
) -> tuple[Trainer, Loader]:
    """A network at its first step, or with the weights of the run `init`, and its batches."""
    recipe, mine = find_recipe(config.recipe), (part.rank, part.world)
    trainer = Trainer(
        recipe,
        config.alpha,
        config.seed,
        device,
        find_architecture(config.network),
        balance=config.balance,
        epoch=max(len(material.frames) // config.batch, 1),
        part=mine,
        folded=init is not None,
    )
    loader = Loader(
        material.frames,
        material.camera,
        config.batch,
        config.seed,
        augment=recipe.augment,
        part=mine,
    )
    if init is None:
        trainer.standardise(loader)
    else:
        trainer.standardise(loader, TUNED_LEAST)
        take_weights(trainer.network, init)
    return trainer, loader


def require_new(out: Path) -> None:
    """Raise UserError when there is something already where a run is to be."""
    if out.exists():
        raise UserError(
            f"{out} already exists; continue that run with --resume, or choose another --out"
        )


def create_run(config: TrainConfig, recipe: Recipe, data: dict[str, Any]) -> None:
    """Make the folder of a new run."""
    config.out.mkdir(parents=True)
    try:
        write_config(config, recipe, data)
    except OSError:
        shutil.rmtree(config.out)  # so that the same command works when the disk does
        raise
