"""Checkpoints of a run in training: one safetensors file each, written whole or not at all.

Tensors: `network.*`, `optimiser.WHICH.INDEX.NAME`, `balance.NAME`, `rng` (torch's generator, for
dropout). Metadata: the step and the seconds trained so far.
"""

from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor
from torch.optim import Optimizer

from mtlnet.inference.model_card import ModelError
from mtlnet.training.trainer import Trainer
from runtime.files import atomic_write

FOLDER = "checkpoints"
KEPT = 2


def save_checkpoint(run: Path, trainer: Trainer, elapsed_s: float) -> Path:
    """Write the state of `trainer` to `run`; the latest `KEPT` checkpoints stay."""
    folder = run / FOLDER
    folder.mkdir(exist_ok=True)
    path = folder / f"step-{trainer.step_number:08d}.safetensors"
    metadata = {"step": str(trainer.step_number), "elapsed_s": repr(elapsed_s)}
    atomic_write(path, save(_tensors(trainer), metadata), fsync=True)
    for old in list_checkpoints(run)[:-KEPT]:
        old.unlink()
    return path


def load_checkpoint(path: Path, trainer: Trainer) -> float:
    """Put the state in `path` into `trainer`; the seconds trained so far.

    Raises ModelError when the file is damaged or of another network.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata()
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 no dict
        _restore(trainer, tensors)
        trainer.step_number = int(metadata["step"])
        return float(metadata["elapsed_s"])
    except (SafetensorError, RuntimeError, KeyError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise ModelError(
            f"the checkpoint {path} cannot be read ({reason}); delete it to resume from the one "
            "before, or start a new run"
        ) from error


def list_checkpoints(run: Path) -> list[Path]:
    """Checkpoints of a run, oldest first."""
    return sorted((run / FOLDER).glob("step-*.safetensors"))


def _tensors(trainer: Trainer) -> dict[str, Tensor]:
    tensors = {f"network.{name}": t for name, t in trainer.network.state_dict().items()}
    for which, optimiser in enumerate(trainer.optimisers.parts):
        for index, state in optimiser.state_dict()["state"].items():
            for name, value in state.items():
                if isinstance(value, Tensor):
                    tensors[f"optimiser.{which}.{index}.{name}"] = value
    for name, tensor in trainer.balance.state().items():
        tensors[f"balance.{name}"] = tensor
    tensors["rng"] = torch.get_rng_state()
    return {name: t.detach().cpu().contiguous() for name, t in tensors.items()}


def _restore(trainer: Trainer, tensors: dict[str, Tensor]) -> None:
    prefix = "network."
    trainer.network.load_state_dict(
        {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}
    )
    for which, optimiser in enumerate(trainer.optimisers.parts):
        prefix = f"optimiser.{which}."
        kept = {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}
        _restore_optimiser(optimiser, kept)
    kept = {n.removeprefix("balance."): t for n, t in tensors.items() if n.startswith("balance.")}
    trainer.balance.restore(kept)
    torch.set_rng_state(tensors["rng"])


def _restore_optimiser(optimiser: Optimizer, tensors: dict[str, Tensor]) -> None:
    state: dict[int, dict[str, Tensor]] = {}
    for key, tensor in tensors.items():
        index, name = key.split(".", 1)
        state.setdefault(int(index), {})[name] = tensor
    groups = optimiser.state_dict()["param_groups"]
    optimiser.load_state_dict({"state": state, "param_groups": groups})
    # Fused optimisers walk a parameter and its state in memory order: channels-last, both.
    for parameter, values in optimiser.state.items():
        for name, value in values.items():
            if isinstance(value, Tensor) and value.shape == parameter.shape:
                values[name] = torch.empty_like(parameter).copy_(value)
