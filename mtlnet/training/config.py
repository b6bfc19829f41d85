"""The configuration of a training run, from its options or from the `config.json` of a run."""

import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import trackfeatures as tf
from mtlnet.inference.model_card import (
    RUNS,
    WEIGHTS,
    ModelCard,
    ModelError,
    check_files,
    read_card,
    resolve_run,
)
from mtlnet.model.architecture import find_architecture, require_task_heads, with_heads
from mtlnet.training.distributed import read_rank
from mtlnet.training.loss import Alpha
from mtlnet.training.recipes import Recipe, find_recipe, learning_rate_factor
from mtlnet.training.task_weighting import require_method
from mtlnet.training.trainer import choose_device
from runtime.files import write_json
from trackfeatures.errors import UserError

CONFIG = "config.json"
DATASET = Path("datasets/default")
MAX_THREADS = 1024
# Fields that may change when a run is resumed; any other would make it a different run.
RESUMABLE_WITH = ("iterations", "minutes", "device", "threads", "data", "change_data")


@dataclass(frozen=True)
class TrainConfig:
    """One training run."""

    data: Path
    out: Path
    network: str = ""
    """A name of `mtlnet.model.architecture.ARCHITECTURES`; empty: the recipe's own."""
    alpha: Alpha = (0.3, 0.2, 0.5)
    balance: str = "fixed"
    """A name of `mtlnet.training.task_weighting.METHODS`; unless it is fixed, alpha only selects
    the tasks that are learned."""
    recipe: str = "fast"
    iterations: int | None = None
    """Steps; None: the recipe's, or as many as fit into `minutes`."""
    minutes: float | None = None
    """Duration of the training itself; the schedule then follows the time elapsed."""
    init: str | None = None
    """The run folder of the model to fine-tune."""
    seed: int = 0
    batch: int = 0
    """Images a step; 0: the recipe's."""
    rate_factor: float = 1.0
    """Of the recipe's learning rate: `recipes.learning_rate_factor` for a run started on a GPU. It
    is stored, so that a run goes on with its rate on any device."""
    device: str = "auto"
    threads: int = 0
    """CPU threads; 0: one a core."""
    skip_undecodable: bool = False
    """Omit frames whose image cannot be decoded; the model's card lists them."""
    hold_out_drives: str = ""
    """Of pictures with a `labels.csv`: the drives to leave out, with commas between them."""
    change_data: bool = False
    """A resumed run continues on `data`, which is not the dataset it was started with."""

    def __post_init__(self) -> None:
        if not self.network:
            object.__setattr__(self, "network", find_recipe(self.recipe).network)
        require_task_heads(find_architecture(self.network), self.alpha)
        require_method(self.balance)
        if self.batch == 0:
            object.__setattr__(self, "batch", find_recipe(self.recipe).batch)
        if (self.init is not None) != find_recipe(self.recipe).from_model:
            raise UserError(
                f"recipe {self.recipe} starts from new weights; with --init give --recipe tune or "
                "continue"
                if self.init is not None
                else f"recipe {self.recipe} starts from a finished model; give it with --init"
            )
        if self.iterations is not None and self.iterations < 1:
            raise UserError(f"--iterations is {self.iterations}; give at least 1")
        if self.minutes is not None and not 0 < self.minutes < math.inf:
            raise UserError(f"--minutes is {self.minutes}; give a number above 0")
        least = 2 if self._has_batch_norm() else 1
        if self.batch < least:
            reason = "batch normalisation needs" if least == 2 else "give"
            raise UserError(f"--batch is {self.batch}; {reason} at least {least}")
        if self.seed < 0:
            raise UserError(f"--seed is {self.seed}; give 0 or more")
        if not 0 <= self.threads <= MAX_THREADS:
            raise UserError(
                f"--threads is {self.threads}; give 0 (one a core) or at most {MAX_THREADS}"
            )

    def _has_batch_norm(self) -> bool:
        """Whether the network is trained with batch normalisation."""
        backbone = find_architecture(self.network).backbone
        return find_recipe(self.recipe).batch_norm or (bool(backbone) and self.init is None)


def new_config(options: Mapping[str, Any], out: Path | None) -> TrainConfig:
    """The configuration of a new run; defaults are those of the network or of the `init` model."""
    if out is None and read_rank().world_size > 1:
        raise UserError("give --out: several processes must use the same folder for the run")
    values: dict[str, Any] = {"data": DATASET, "recipe": "fast"}
    if "init" in options:
        run, card = open_pretrained(options["init"])
        values.update(network=card.network, alpha=card.alpha, recipe="tune")
        options = {**options, "init": str(run)}
    elif network := options.get("network"):
        values["alpha"] = find_architecture(network).default_alpha
    values.update(options)
    recipe = find_recipe(values["recipe"]).name
    values.update(_for_gpu(values))
    if heads := values.pop("heads", None):
        if "init" in options:
            raise UserError("a fine-tuned model keeps its heads; leave --heads out with --init")
        values["network"] = with_heads(values.get("network", find_recipe(recipe).network), heads)
    folder = out or RUNS / f"{time.strftime('%Y%m%d-%H%M%S')}-{recipe}"
    return TrainConfig(out=folder, **values)


def _for_gpu(values: Mapping[str, Any]) -> dict[str, Any]:
    """The batch and the factor of the learning rate of a new run, if it is trained on a GPU."""
    if choose_device(values.get("device", "auto"), read_rank()).type != "cuda":
        return {}
    recipe = find_recipe(values["recipe"])
    batch = values.get("batch") or recipe.gpu_batch or recipe.batch
    return {"batch": batch, "rate_factor": learning_rate_factor(recipe, max(batch, 1))}


def open_pretrained(name: str | Path) -> tuple[Path, ModelCard]:
    """The folder and card of the model to fine-tune; ModelError when it is missing or damaged."""
    run = resolve_run(name)
    card = read_card(run)
    check_files(run, card, (WEIGHTS,))
    return run, card


def write_config(config: TrainConfig, recipe: Recipe, data: Mapping[str, Any]) -> None:
    """Write `config.json` of a run."""
    values = {**asdict(config), "data": str(config.data), "out": str(config.out)}
    content = {
        "definitions": tf.VERSION,
        "config": {**values, "change_data": False},  # once: later the data is the run's own
        "recipe": asdict(recipe),
        "data": dict(data),
    }
    write_json(config.out / CONFIG, content)


def read_config(run: Path) -> tuple[TrainConfig, dict[str, Any]]:
    """The configuration of a run, and the description of its data. Raises ModelError."""
    path = run / CONFIG
    if not path.is_file():
        raise ModelError(
            f"{run} is not a training run ({CONFIG} is missing); give the --out of a run to resume"
        )
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        tf.require_version(content["definitions"], f"the run in {run}")
        values = content["config"]
        values.update(data=Path(values["data"]), out=run, alpha=tuple(values["alpha"]))
        return TrainConfig(**values), content["data"]
    except (ValueError, KeyError, TypeError) as error:
        raise ModelError(f"{path} is damaged ({error!r}); start a new run") from error


def resume_config(run: Path, given: Mapping[str, Any]) -> tuple[TrainConfig, dict[str, Any]]:
    """The stored configuration, with the fields `given` on the command line.

    Raises UserError when a field is given that would make it a different run.
    """
    stored, data = read_config(run)
    given = dict(given)
    if heads := given.pop("heads", None):
        given["network"] = with_heads(given.get("network", stored.network), heads)
    for name, value in given.items():
        kept = getattr(stored, name)
        if name not in RESUMABLE_WITH and value != kept:
            raise UserError(
                f"{run} was started with {name} {kept}, now {value} is asked for; leave it out to "
                "resume, or start a new run with another --out"
            )
    return replace(stored, **{k: v for k, v in given.items() if k in RESUMABLE_WITH}), data


def newest_run() -> Path:
    """The run in `runs/` that was started last; ModelError when there is none."""
    runs = [p.parent for p in RUNS.glob(f"*/{CONFIG}") if not p.parent.is_symlink()]
    if not runs:
        raise ModelError(f"there is no run in {RUNS}/ to resume; give its folder with --out")
    return max(runs, key=lambda run: (run / CONFIG).stat().st_mtime)
