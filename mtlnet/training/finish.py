"""The end of a run: its network published in its folder."""

from pathlib import Path

import numpy as np

from mtlnet.data.sources import TrainingData
from mtlnet.export.publish import Provenance, publish
from mtlnet.inference.model_card import RUNS, ModelCard
from mtlnet.model.architecture import HEIGHT, WIDTH
from mtlnet.model.network import fold
from mtlnet.training.config import TrainConfig
from mtlnet.training.trainer import Trainer
from mtlnet.uncertainty_fit.head import fit_uncertainty_head

CHECK_FRAMES = 16
"""Frames on which the exported graph is held against torch."""


def finish(config: TrainConfig, trainer: Trainer, material: TrainingData) -> ModelCard:
    """Publish the trained network in the run's folder."""
    frames = material.frames
    chosen = np.linspace(0, len(frames) - 1, min(CHECK_FRAMES, len(frames))).astype(np.int64)
    images = frames.read_batch(chosen, np.empty((len(chosen), HEIGHT, WIDTH, 3), np.uint8))
    card = publish(
        trainer.network,
        config.out,
        images,
        Provenance(
            camera=material.camera,
            alpha=config.alpha,
            recipe=config.recipe,
            iterations=trainer.step_number,
            batch=config.batch,
            seed=config.seed,
            data=material.about,
        ),
        uncertainty=fit_uncertainty_head(
            fold(trainer.network), frames, material.held_out, config.seed, material.camera
        ),
    )
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
