"""Judging a model on the rounds of a dataset: `mtlnet evaluate --model RUN --data DIR --json`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.recording import Dataset, Frames
from mtlnet.answer import OUTPUTS
from mtlnet.card import ModelCard, ModelError
from mtlnet.engine import Engine
from mtlnet.report import judge, judge_groups

CHUNK = 64


def evaluate(
    engine: Engine, data: Path, split: str, report: Callable[[int, int], None] = lambda *_: None
) -> dict[str, Any]:
    """The report of `mtlnet.report.judge` on one side of a dataset, whole and by groups.

    `report(done, all)` is told how far it is. Raises UserError when data and model do not fit.
    """
    dataset = Dataset.open(data)
    frames = dataset.select(split)
    require_fit(engine.card, frames, split)
    outputs = answer_frames(engine, frames, report)
    mean = engine.card.data["mean"]
    return {
        "model": engine.card.name,
        "model_hash": engine.card.model_hash,
        "data": str(data),
        "split": split,
        "rounds": len(frames.rounds),
        **judge(outputs, frames.labels, mean),
        **judge_groups(outputs, frames, mean),
    }


def answer_frames(
    engine: Engine, frames: Frames, report: Callable[[int, int], None] = lambda *_: None
) -> NDArray[np.float32]:
    """The outputs (N, 9) of the engine for all frames, one by one as in service."""
    camera = engine.card.camera
    outputs = np.empty((len(frames), OUTPUTS), np.float32)
    images = np.empty((CHUNK, camera.height, camera.width, 3), np.uint8)
    for first in range(0, len(frames), CHUNK):
        rows = np.arange(first, min(first + CHUNK, len(frames)))
        for row, image in zip(rows, frames.read_batch(rows, images[: len(rows)]), strict=True):
            outputs[row] = engine(image)
        report(int(rows[-1]) + 1, len(frames))
    return outputs


def require_fit(card: ModelCard, frames: Frames, split: str) -> None:
    """Raise ModelError when the camera differs, or when what is to judge it was trained on."""
    found, expected = frames.camera.as_dict(), vars(card.camera)
    if found != expected:
        differing = ", ".join(
            f"{k} {found[k]:g} instead of {expected[k]:g}"
            for k in expected
            if found[k] != expected[k]
        )
        raise ModelError(
            f"the camera of the data is not that of model {card.name}: {differing}; collect with "
            "the model's camera, or train a model for this one"
        )
    if "mean" not in card.data:
        raise ModelError(f"model {card.name} does not say what it was trained on; train it anew")
    if split not in ("test", "unseen"):
        return
    seen = {info.seed for info in frames.rounds} & set(card.data["seeds"])
    if seen:
        raise ModelError(
            f"model {card.name} was trained on the round of seed {min(seen)}, a {split} round of "
            "this data: the result would say nothing; use --split all, or other rounds"
        )
    known = {info.track for info in frames.rounds} & set(card.data.get("tracks", ()))
    if split == "unseen" and known:
        raise ModelError(
            f"model {card.name} was trained on track {min(known)}, which is not unseen to it; "
            "collect another with `datagen collect --split unseen --tracks NAME`"
        )
