"""The steps of a run, until its iterations or its minutes are used up; checkpoints on the way."""

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mtlnet.data.gpu_cache import DeviceBatch, GpuDataset
from mtlnet.data.loader import Batch, Loader
from mtlnet.training.checkpoint import save_checkpoint
from mtlnet.training.config import TrainConfig
from mtlnet.training.distributed import Part, agree
from mtlnet.training.logging import Curves
from mtlnet.training.trainer import Trainer
from trackfeatures.errors import UserError

LOG_EVERY = 10
CHECKPOINT_SECONDS = 60.0
DIVERGED = (
    "training stops, the last good checkpoint stays; start anew with smaller --alpha or another "
    "--seed, or look at the data with `datagen verify`"
)


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


def learn(
    config: TrainConfig,
    trainer: Trainer,
    loader: Loader | GpuDataset,
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
        batches: Iterator[Batch | DeviceBatch] = loader.batches(trainer.step_number)
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


# Ctrl-C as a request, to be met between two steps and not in the middle of one.


class StopRequest:
    """While entered, the first Ctrl-C (or SIGTERM) sets `requested`; a second one interrupts."""

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[int, Any] = {}

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True

    def __enter__(self) -> "StopRequest":
        for number in (signal.SIGINT, signal.SIGTERM):
            try:
                self._before[number] = signal.signal(number, self._note)
            except ValueError:  # only the main thread may; elsewhere nobody interrupts us
                break
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
