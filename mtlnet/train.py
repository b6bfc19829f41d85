"""Training a model from a dataset: `mtlnet train --data DIR --out RUN --alpha 0.3,0.2,0.5`.

Ends with the finished model in the run's folder (see `mtlnet.publish`); stopped by Ctrl-C it
leaves a checkpoint to go on from with `--resume`.
"""

import os
import re
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from datagen.recording import Dataset, Frames
from mtlnet.card import RUNS, Camera, ModelCard, ModelError, read_card
from mtlnet.checkpoint import list_checkpoints, load_checkpoint, save_checkpoint
from mtlnet.config import TrainConfig, write_config
from mtlnet.curves import Curves
from mtlnet.doubt_fit import fit_doubt
from mtlnet.fine_tune import (
    TUNED_LEAST,
    Material,
    continued,
    open_init,
    own_material,
    round_material,
    take_weights,
)
from mtlnet.interrupt import StopRequest
from mtlnet.loader import Loader
from mtlnet.network import HEIGHT, WIDTH, fold
from mtlnet.own_images import OwnImages, is_own
from mtlnet.plan import find_plan
from mtlnet.publish import publish
from mtlnet.recipe import Recipe, find_recipe
from mtlnet.together import ALONE, Part, agree, find_part, joined, wait
from mtlnet.trainer import Trainer, keep_freed_memory
from trackfeatures.errors import UserError

LOG_EVERY = 10
CHECKPOINT_SECONDS = 60.0
DIVERGED = (
    "training stops, the last good checkpoint stays; start anew with smaller --alpha or another "
    "--seed, or look at the data with `datagen verify`"
)
CHECK_FRAMES = 16
"""Frames on which the exported graph is held against torch."""


@dataclass(frozen=True)
class Progress:
    """Where a run is: `fraction` in [0, 1]; losses as logged (distance, angle, type, total)."""

    step: int
    fraction: float
    elapsed_s: float
    images_per_second: float
    losses: NDArray[np.float64]


class Stopped(KeyboardInterrupt):
    """The user stopped the run; its state is in the checkpoint named."""


Report = Callable[[Progress], None]


def train(
    config: TrainConfig, resumed: dict[str, Any] | None, report: Report = lambda _: None
) -> ModelCard:
    """Train by `config` and publish the model in `config.out`.

    `resumed`: the description of the data as the run was started with, to go on with it; None
    starts a new run. Raises UserError (data, an existing folder), Stopped after Ctrl-C.
    """
    recipe = find_recipe(config.recipe)
    part = find_part()
    device = choose_device(config.device, part)
    try:
        with joined(part, device, config.batch):
            return _train(config, resumed, report, recipe, device, part)
    except torch.OutOfMemoryError as error:
        raise UserError(
            f"the memory of {device} is used up; give a smaller --batch than {config.batch}, or "
            "train with --device cpu"
        ) from error


def _train(
    config: TrainConfig,
    resumed: dict[str, Any] | None,
    report: Report,
    recipe: Recipe,
    device: torch.device,
    part: Part,
) -> ModelCard:
    init = None if config.init is None else open_init(config.init)
    material = open_material(config, init[1] if init else None)
    frames, camera, data = material.frames, material.camera, material.about
    if resumed is None and part.first:
        create_run(config, recipe, data)
    if resumed is not None:
        require_same_data(config, resumed, data)
    torch.set_num_threads(config.threads or max((os.cpu_count() or 1) // part.local, 1))
    cv2.setNumThreads(1)  # the loader's images are small: a second pool would only fight torch's
    keep_freed_memory()
    mine = (part.rank, part.world)
    trainer = Trainer(
        recipe,
        config.alpha,
        config.seed,
        device,
        find_plan(config.network),
        balance=config.balance,
        epoch=max(len(frames) // config.batch, 1),
        part=mine,
        folded=init is not None,
    )
    loader = Loader(frames, camera, config.batch, config.seed, augment=recipe.augment, part=mine)
    if init is None:
        trainer.standardise(loader)
    else:
        trainer.standardise(loader, TUNED_LEAST)
        take_weights(trainer.network, init[0])
    elapsed_s = 0.0
    checkpoints = list_checkpoints(config.out) if resumed is not None else []
    if checkpoints:
        elapsed_s = load_checkpoint(checkpoints[-1], trainer)
    wait()  # until all have read it, the first one writes nothing
    try:
        learn(config, trainer, loader, elapsed_s, report, part)
        if part.first:
            finish(config, trainer, frames, material.held_out, camera, data)
        wait()
        return read_card(config.out)
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        raise UserError(
            f"the run in {config.out} broke off: {error.strerror or error}{where}; mend that, then "
            f"go on with `mtlnet train --out {config.out} --resume`"
        ) from error


def finish(
    config: TrainConfig,
    trainer: Trainer,
    frames: Frames | OwnImages,
    held_out: Frames | None,
    camera: Camera,
    data: dict[str, Any],
) -> ModelCard:
    """Publish the trained network in the run's folder."""
    chosen = np.linspace(0, len(frames) - 1, min(CHECK_FRAMES, len(frames))).astype(np.int64)
    images = frames.read_batch(chosen, np.empty((len(chosen), HEIGHT, WIDTH, 3), np.uint8))
    card = publish(
        trainer.network,
        config.out,
        images,
        camera=camera,
        alpha=config.alpha,
        recipe=config.recipe,
        iterations=trainer.step_number,
        batch=config.batch,
        seed=config.seed,
        data=data,
        doubt=fit_doubt(fold(trainer.network), frames, held_out, config.seed),
    )
    link_latest(config.out)
    return card


def learn(
    config: TrainConfig,
    trainer: Trainer,
    loader: Loader,
    elapsed_s: float,
    report: Report,
    part: Part,
) -> None:
    """Take steps until the iterations or the minutes are used up; checkpoints on the way."""
    written = Curves(config.out, trainer.step_number) if part.first else None
    begin = time.perf_counter() - elapsed_s
    saved = logged = time.perf_counter()
    window: list[torch.Tensor] = []
    with written or nullcontext() as curves, StopRequest() as stop:
        batches = loader.batches(trainer.step_number)
        while True:
            now = time.perf_counter()
            here = [fraction(config, trainer, now - begin), stop.requested, now - saved]
            done, stopping, unsaved_s = agree(here, trainer.device)
            if stopping or unsaved_s > CHECKPOINT_SECONDS:
                require_finite(window, trainer.step_number)
                path = keep(config, trainer, now - begin, part)
                saved = now
                if stopping:
                    raise Stopped(str(path))
            if done >= 1.0:
                break
            losses = trainer.step(next(batches), done)
            window.append(losses.row())
            if trainer.device.type == "cpu":  # on a GPU, asking would wait for it
                require_finite(window[-1:], trainer.step_number)
            if trainer.step_number % LOG_EVERY == 0:
                now = time.perf_counter()
                require_finite(window, trainer.step_number)
                means = torch.stack(window).double().mean(0).cpu().numpy()
                speed = len(window) * config.batch / (now - logged)
                window, logged = [], now
                point = Progress(trainer.step_number, done, now - begin, speed, means)
                if curves is not None:
                    row = as_row(point, trainer)
                    curves.write(dict(zip(curves.columns, row, strict=True)))
                    report(point)
        require_finite(window, trainer.step_number)
        keep(config, trainer, time.perf_counter() - begin, part)


def keep(config: TrainConfig, trainer: Trainer, elapsed_s: float, part: Part) -> Path:
    """Save a checkpoint, in the first process."""
    if not part.first:
        return config.out
    if not all(bool(p.isfinite().all()) for p in trainer.network.parameters()):
        raise UserError(
            f"a weight is no finite number after batch {trainer.step_number}; {DIVERGED}"
        )
    return save_checkpoint(config.out, trainer, elapsed_s)


def fraction(config: TrainConfig, trainer: Trainer, elapsed_s: float) -> float:
    """How much of the run is done, by steps or by the clock, whichever is further."""
    recipe_steps = None if config.minutes is not None else trainer.recipe.iterations
    steps = config.iterations or recipe_steps
    by_steps = trainer.step_number / steps if steps else 0.0
    by_clock = elapsed_s / (60 * config.minutes) if config.minutes is not None else 0.0
    return max(by_steps, by_clock)


def as_row(point: Progress, trainer: Trainer) -> tuple[float, ...]:
    """A point of the curves, in the order of their columns."""
    rate = trainer.optimisers.rate
    head = (point.step, point.elapsed_s, rate, point.images_per_second)
    return (*head, *point.losses.tolist(), *trainer.balance.weights())


def require_finite(window: Sequence[torch.Tensor], step: int) -> None:
    """Raise UserError when training has diverged in the last steps: losses (4,) each."""
    for before, losses in enumerate(reversed(window)):
        if not bool(losses.isfinite().all()):
            raise UserError(
                f"the loss of batch {step - before} is no finite number (distance, angle, type, "
                f"total: {losses.tolist()}); {DIVERGED}"
            )


def open_material(config: TrainConfig, init: ModelCard | None) -> Material:
    """What `config.data` holds, recorded rounds or a user's own images; UserError: it cannot be."""
    if init is not None and init.network != config.network:
        raise UserError(f"--init is a {init.network}, not a {config.network}; leave out --network")
    if is_own(config.data):
        material = own_material(config.data, init)
    else:
        material = round_material(open_training_data(config.data))
    return material if init is None else continued(material, init)


def open_training_data(path: Path) -> Dataset:
    """The dataset in folder `path`; UserError when it does not fit this network."""
    dataset = Dataset.open(path)
    camera = dataset.camera
    if (camera.width, camera.height) != (WIDTH, HEIGHT):
        raise UserError(
            f"the images of {path} are {camera.width} x {camera.height}, the network takes "
            f"{WIDTH} x {HEIGHT}; collect with the default camera size"
        )
    dataset.select("train")  # raises where there are none
    return dataset


def create_run(config: TrainConfig, recipe: Recipe, data: dict[str, Any]) -> None:
    """Make the folder of a new run; UserError when there is something already."""
    out = config.out
    if out.exists():
        raise UserError(
            f"{out} already exists; continue that run with --resume, or choose another --out"
        )
    out.mkdir(parents=True)
    try:
        write_config(config, recipe, data)
    except OSError:
        shutil.rmtree(out)  # so that the same command works when the disk does
        raise


def require_same_data(config: TrainConfig, resumed: dict[str, Any], data: dict[str, Any]) -> None:
    """Raise ModelError unless the run goes on with what it began with."""
    for name in ("content_hash", "split", "init"):
        if resumed.get(name) != data.get(name):
            raise ModelError(
                f"the {name.replace('_', ' ')} of {config.data} is not the one {config.out} was "
                "started with; give that dataset with --data, or start a new run"
            )


def choose_device(name: str, part: Part = ALONE) -> torch.device:
    """The device called `name`; "auto": a GPU where there is one."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and part.local > 1:
        name = f"cuda:{part.local_rank}"
    if not re.fullmatch(r"cpu|cuda(:\d{1,3})?", name):
        raise UserError(f"--device {name!r} is not known; use auto, cpu, cuda or cuda:NUMBER")
    device = torch.device(name)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise UserError(f"--device {name}: torch finds no GPU here; use --device cpu")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise UserError(f"--device {name}: torch finds {torch.cuda.device_count()} GPU(s) here")
    return device


def link_latest(run: Path) -> None:
    """Point `runs/latest` to `run` when it lies in `runs/`."""
    if run.resolve().parent != RUNS.resolve():
        return
    link = RUNS / "latest.partial"
    link.unlink(missing_ok=True)
    link.symlink_to(run.resolve().name)
    link.replace(RUNS / "latest")
