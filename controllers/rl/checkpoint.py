"""Writes and reads the checkpoint of a training: one safetensors file, written between episodes.

Its tensors are the networks' parameters, Adam's moments and the replay; its metadata is the
progress as JSON.
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from runtime.files import atomic_write, utf8_path
from trackfeatures.errors import UserError

FILE = "checkpoint.safetensors"
Row = tuple[float, ...]
Tensors = dict[str, NDArray[Any]]


@dataclass
class Progress:
    """The progress of a training."""

    step: int = 0
    """Control steps done."""
    episode: int = 0
    """Episodes done."""
    seconds: float = 0.0
    """Wall-clock time of the training."""
    loss: float = float("nan")
    """Mean of the critics' losses over the last episode."""
    evaluated: int = 0
    """Step of the last drive on the training track."""
    best_score: float = float("-inf")
    """Largest mean reward per step of a drive on the training track."""
    best_step: int = 0
    """Step of the best drive."""
    curve: list[Row] = field(default_factory=list)
    """The rows of `curve.csv`, one for each drive."""


class Learner(Protocol):
    """Networks in training, whose state can be stored and restored."""

    def store(self) -> tuple[Tensors, dict[str, int]]:
        """Return the arrays, and the counts (e.g. of updates), that a continued training needs, by
        name."""
        ...

    def restore(self, tensors: Tensors, counts: dict[str, int]) -> None:
        """Restore the result of `store`. Raises KeyError for a missing array or count, ValueError
        for an array of another shape."""
        ...


def save_checkpoint(run: Path, learner: Learner, progress: Progress) -> None:
    """Write the state of a training to the folder `run`."""
    tensors, counts = learner.store()
    metadata = {"progress": json.dumps(asdict(progress)), "counts": json.dumps(counts)}
    atomic_write(run / FILE, save(tensors, metadata), fsync=True)


def load_checkpoint(run: Path, learner: Learner) -> Progress | None:
    """Restore `learner` from the checkpoint in the folder `run`; returns the progress, or None
    without a checkpoint.

    Raises UserError for a damaged checkpoint.
    """
    path = run / FILE
    if not path.exists():
        return None
    try:
        with utf8_path(path) as plain, safe_open(plain, framework="np") as file:
            metadata = file.metadata()
            progress = Progress(**json.loads(metadata["progress"]))
            progress.curve = [tuple(row) for row in progress.curve]
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        learner.restore(tensors, json.loads(metadata["counts"]))
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise UserError(
            f"the checkpoint {path} cannot be read ({error}); delete it to train from the start"
        ) from error
    return progress
