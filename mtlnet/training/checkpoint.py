"""Saves and restores the state of a training run. A checkpoint is one safetensors file, written
atomically.

Its tensors are `network.NAME`, `units.NAME` (`target_mean` and `target_std` of the network),
`optimiser.I.J.NAME` (state of parameter number J of optimizer number I), `balance.NAME` (state of
the task weighting) and `rng` (state of torch's CPU generator in the first process, for dropout).
Its metadata are `step` and `elapsed_s`, the seconds trained so far.
"""

from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor
from torch.optim import Optimizer

from mtlnet.inference.model_card import ModelError
from mtlnet.training.trainer import Trainer
from runtime.files import atomic_write, utf8_path

FOLDER = "checkpoints"
MAX_CHECKPOINTS = 2
UNITS = ("target_mean", "target_std")
"""Buffers of the network that its state dict lacks if it has no batch normalisation. Checkpoints of
earlier versions have no `units.NAME`; then the values measured on the data are kept."""


def save_checkpoint(run: Path, trainer: Trainer, elapsed_s: float) -> Path:
    """Write a checkpoint of `trainer` into the folder `run`, and return its path.

    Keeps the two newest checkpoints of the run and deletes all others. `elapsed_s`: seconds trained
    so far.
    """
    folder = run / FOLDER
    folder.mkdir(exist_ok=True)
    path = folder / f"step-{trainer.step_number:08d}.safetensors"
    metadata = {"step": str(trainer.step_number), "elapsed_s": repr(elapsed_s)}
    atomic_write(path, save(_tensors(trainer), metadata), fsync=True)
    for old in list_checkpoints(run)[:-MAX_CHECKPOINTS]:
        old.unlink()
    return path


def load_checkpoint(path: Path, trainer: Trainer) -> float:
    """Restore `trainer` from the checkpoint `path`; returns the seconds trained before it.

    Raises ModelError when the file is damaged or belongs to another network.
    """
    try:
        with utf8_path(path) as plain, safe_open(plain, framework="pt") as file:
            metadata = file.metadata()
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 no dict
        trainer.step_number = int(metadata["step"])
        _restore(trainer, tensors)
        return float(metadata["elapsed_s"])
    except (SafetensorError, RuntimeError, KeyError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise ModelError(
            f"the checkpoint {path} cannot be read ({reason}); delete it to resume from the one "
            "before, or start a new run"
        ) from error


def list_checkpoints(run: Path) -> list[Path]:
    """Return the paths of a run's checkpoints, oldest first."""
    return sorted((run / FOLDER).glob("step-*.safetensors"))


def _tensors(trainer: Trainer) -> dict[str, Tensor]:
    tensors = {f"network.{name}": t for name, t in trainer.network.state_dict().items()}
    for name in UNITS:
        # A copy, because safetensors refuses two tensors in the same memory.
        tensors[f"units.{name}"] = trainer.network.get_buffer(name).clone()
    for number, optimizer in enumerate(trainer.optimizers.optimizers):
        for index, state in optimizer.state_dict()["state"].items():
            for name, value in state.items():
                if isinstance(value, Tensor):
                    tensors[f"optimiser.{number}.{index}.{name}"] = value
    for name, tensor in trainer.task_weighting.state().items():
        tensors[f"balance.{name}"] = tensor
    tensors["rng"] = torch.get_rng_state()
    return {name: t.detach().cpu().contiguous() for name, t in tensors.items()}


def _restore(trainer: Trainer, tensors: dict[str, Tensor]) -> None:
    trainer.network.load_state_dict(_with_prefix(tensors, "network."))
    for name, tensor in _with_prefix(tensors, "units.").items():
        trainer.network.get_buffer(name).copy_(tensor)
    for number, optimizer in enumerate(trainer.optimizers.optimizers):
        _restore_optimizer(optimizer, _with_prefix(tensors, f"optimiser.{number}."))
    trainer.task_weighting.restore(_with_prefix(tensors, "balance."))
    trainer.seed_dropout()
    if trainer.rank.is_first:
        torch.set_rng_state(tensors["rng"])


def _with_prefix(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin with `prefix`, which is removed from the names."""
    return {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}


def _restore_optimizer(optimizer: Optimizer, tensors: dict[str, Tensor]) -> None:
    state: dict[int, dict[str, Tensor]] = {}
    for key, tensor in tensors.items():
        index, name = key.split(".", 1)
        state.setdefault(int(index), {})[name] = tensor
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})
    # Fused optimizers read a parameter and its state in memory order: both must be channels-last.
    for parameter, values in optimizer.state.items():
        for name, value in values.items():
            if isinstance(value, Tensor) and value.shape == parameter.shape:
                values[name] = torch.empty_like(parameter).copy_(value)
