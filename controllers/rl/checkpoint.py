"""The checkpoint of a training: one safetensors file, written between two episodes.

Its tensors are the agent's parameters, Adam's moments and the replay; its metadata is the progress
as JSON.
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from controllers.rl.agent import Agent
from runtime.files import atomic_write, utf8_path
from trackfeatures.errors import UserError

FILE = "checkpoint.safetensors"
Row = tuple[float, ...]


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
    """Best reward per step of these drives."""
    best_step: int = 0
    """Step of the best drive."""
    curve: list[Row] = field(default_factory=list)
    """The rows of `curve.csv`, one for each drive."""


def save_checkpoint(run: Path, agent: Agent, progress: Progress) -> None:
    """Write the state of a training to the folder `run`."""
    tensors = _parameters(agent)
    filled = len(agent.replay)
    for name in ("states", "next_states", "results"):
        tensors[f"replay.{name}"] = getattr(agent.replay, name)[:filled]
    counts = {"updates": agent.updates, "added": agent.replay.added}
    metadata = {"progress": json.dumps(asdict(progress)), "counts": json.dumps(counts)}
    atomic_write(run / FILE, save(tensors, metadata), fsync=True)


def load_checkpoint(run: Path, agent: Agent) -> Progress | None:
    """Restore `agent` from the checkpoint in `run`; returns None without a checkpoint.

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
            counts = json.loads(metadata["counts"])
            for name, array in _parameters(agent).items():
                array[:] = file.get_tensor(name)
            for name in ("states", "next_states", "results"):
                kept = file.get_tensor(f"replay.{name}")
                getattr(agent.replay, name)[: len(kept)] = kept
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise UserError(
            f"the checkpoint {path} cannot be read ({error}); delete it to train from the start"
        ) from error
    agent.updates, agent.replay.added = counts["updates"], counts["added"]
    return progress


def _parameters(agent: Agent) -> dict[str, NDArray[np.float32]]:
    """The agent's arrays by name; they are not copied."""
    return {
        f"{name}.{part}": getattr(networks, part)
        for name, networks in (("actor", agent.actor), ("critics", agent.critics))
        for part in ("theta", "target", "moments")
    }
