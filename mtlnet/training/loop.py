"""Takes training steps until the iterations or minutes are used up, and saves checkpoints."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from signal import SIGHUP, SIGINT, SIGTERM

import numpy as np
import torch
from numpy.typing import NDArray

from mtlnet.data.gpu_cache import DeviceBatch, GpuDataset
from mtlnet.data.loader import Batch, Loader
from mtlnet.training.checkpoint import save_checkpoint
from mtlnet.training.config import TrainConfig
from mtlnet.training.distributed import broadcast
from mtlnet.training.logging import CurveLog
from mtlnet.training.trainer import Trainer
from runtime.signals import interrupts
from trackfeatures.errors import UserError

LOG_EVERY = 10
"""Number of steps between two points of the curves."""
CHECKPOINT_SECONDS = 60.0
"""Time between two checkpoints, s."""
STOPPING = (SIGINT, SIGTERM, SIGHUP)
"""Signals that stop a training between two steps."""
DIVERGED = (
    "training stops and the last good checkpoint is kept; start a new run with smaller --alpha or "
    "another --seed, or check the data with `datagen verify`"
)


@dataclass(frozen=True)
class TrainProgress:
    """Progress of a run after `step` steps. `fraction`: share of the run that is done, in [0, 1].
    `losses` (4,): distance, angle, class and total loss, means over the last ten steps."""

    step: int
    fraction: float
    elapsed_s: float
    images_per_second: float
    losses: NDArray[np.float64]


class Stopped(KeyboardInterrupt):
    """Raised when the user stops the run; the argument is the path of the checkpoint."""


Report = Callable[[TrainProgress], None]


def train_loop(
    config: TrainConfig,
    trainer: Trainer,
    loader: Loader | GpuDataset,
    elapsed_s: float,
    report: Report,
) -> None:
    """Train until the iterations or the minutes are used up, and save checkpoints.

    `elapsed_s`: seconds trained before this call. `report` is called every ten steps. Raises
    Stopped after Ctrl-C, SIGTERM or SIGHUP, UserError when the training diverges.
    """
    log = CurveLog(config.out, trainer.step_number) if trainer.rank.is_first else None
    begin = time.perf_counter() - elapsed_s
    saved = logged = time.perf_counter()
    window: list[torch.Tensor] = []
    with log or nullcontext(), interrupts(*STOPPING) as stop_requested:
        batches: Iterator[Batch | DeviceBatch] = loader.batches(trainer.step_number)
        while True:
            now = time.perf_counter()
            own = [fraction_done(config, trainer, now - begin), stop_requested(), now - saved]
            fraction, stopping, unsaved_s = broadcast(own, trainer.device)
            if stopping or unsaved_s > CHECKPOINT_SECONDS:
                require_finite(window, trainer.step_number)
                path = save(config, trainer, now - begin)
                saved = now
                if stopping:
                    raise Stopped(str(path))
            if fraction >= 1.0:
                break
            losses = trainer.step(next(batches), fraction)
            window.append(losses.row())
            if trainer.device.type == "cpu":  # on a GPU this check would wait for the step's end
                require_finite(window[-1:], trainer.step_number)
            if trainer.step_number % LOG_EVERY == 0:
                now = time.perf_counter()
                rows = torch.stack(window).double().cpu()  # the only wait for a GPU
                require_finite(rows.unbind(), trainer.step_number)
                means = rows.mean(0).numpy()
                speed = len(window) * config.batch / (now - logged)
                window, logged = [], now
                progress = TrainProgress(trainer.step_number, fraction, now - begin, speed, means)
                if log is not None:
                    log.write(curve_point(progress, trainer))
                    report(progress)
        require_finite(window, trainer.step_number)
        save(config, trainer, time.perf_counter() - begin)


def save(config: TrainConfig, trainer: Trainer, elapsed_s: float) -> Path:
    """Save a checkpoint in the first process and return its path; all other processes save nothing
    and return the run's folder. Raises UserError when a weight is not finite."""
    if not trainer.rank.is_first:
        return config.out
    if not all(bool(p.isfinite().all()) for p in trainer.network.parameters()):
        raise UserError(
            f"a weight is not a finite number after batch {trainer.step_number}; {DIVERGED}"
        )
    return save_checkpoint(config.out, trainer, elapsed_s)


def fraction_done(config: TrainConfig, trainer: Trainer, elapsed_s: float) -> float:
    """Compute the fraction of the run that is done, the larger of the fractions of its steps and of
    its time. `elapsed_s`: seconds trained so far."""
    recipe_steps = None if config.minutes is not None else trainer.recipe.iterations
    steps = config.iterations or recipe_steps
    by_steps = trainer.step_number / steps if steps else 0.0
    by_time = elapsed_s / (60 * config.minutes) if config.minutes is not None else 0.0
    return max(by_steps, by_time)


def curve_point(progress: TrainProgress, trainer: Trainer) -> dict[str, float]:
    """Make one row of `curves.csv`, a dict from the name of a column to its value."""
    values = (
        progress.step,
        progress.elapsed_s,
        trainer.optimizers.learning_rate,
        progress.images_per_second,
        *progress.losses.tolist(),
        *trainer.task_weighting.current_weights(),
    )
    return dict(zip(CurveLog.columns, values, strict=True))


def require_finite(window: Sequence[torch.Tensor], step: int) -> None:
    """Raise UserError when a loss is not finite.

    `window`: the losses (4,) of each of the last steps, up to the step numbered `step`.
    """
    for steps_before, losses in enumerate(reversed(window)):
        if not bool(losses.isfinite().all()):
            raise UserError(
                f"the loss of batch {step - steps_before} is not a finite number (distance, angle, "
                f"heading, total: {losses.tolist()}); {DIVERGED}"
            )
