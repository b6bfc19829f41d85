"""Makes the configuration of a new run from its options, and writes and reads `config.json`."""

import json
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import trackfeatures as tf
from mtlnet.architecture import find_architecture, with_heads
from mtlnet.inference.model_card import (
    RUNS,
    WEIGHTS,
    ModelCard,
    ModelError,
    check_files,
    read_card,
    resolve_run,
)
from mtlnet.inference.trained_rounds import shortened
from mtlnet.training.config import CONFIG, TrainConfig
from mtlnet.training.device import choose_device
from mtlnet.training.distributed import read_rank
from mtlnet.training.recipes import Recipe, find_recipe, learning_rate_factor
from runtime.files import write_json
from trackfeatures.errors import UserError

DATASET = Path("datasets/default")
RESUMABLE_WITH = ("iterations", "minutes", "init_share", "device", "threads", "data", "change_data")
"""Fields of TrainConfig that may change when a run is resumed; a change of any other field is
refused."""
ABOUT_DATA = ("hold_out_drives", "skip_undecodable")
"""Fields of TrainConfig about the dataset. With `change_data` they may change, and another dataset
starts with their defaults."""


def new_config(options: Mapping[str, Any], out: Path | None) -> TrainConfig:
    """Make the configuration of a new run from the `options` given on the command line.

    Defaults come from the recipe, the network or the `init` model. `out`: folder of the run; None
    for `runs/DATE-RECIPE`. Raises UserError for options that contradict each other.
    """
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
    """The fields `batch` and `rate_factor` of a new run on a GPU; an empty dict on a CPU."""
    if choose_device(values.get("device", "auto"), read_rank()).type != "cuda":
        return {}
    recipe = find_recipe(values["recipe"])
    batch = values.get("batch") or recipe.gpu_batch or recipe.batch
    return {"batch": batch, "rate_factor": learning_rate_factor(recipe, max(batch, 1))}


def open_pretrained(name: str | Path) -> tuple[Path, ModelCard]:
    """Find the model `name` (a run or a shipped model) from which a run starts, check its weights,
    and return its folder and card.

    Raises ModelError when the model is missing or damaged.
    """
    run = resolve_run(name)
    card = read_card(run)
    check_files(run, card, (WEIGHTS,))
    return run, card


def write_config(config: TrainConfig, recipe: Recipe, data: Mapping[str, Any]) -> None:
    """Write `config.json` into the run's folder; `data` is the description of the run's dataset."""
    values = {**asdict(config), "data": str(config.data), "out": str(config.out)}
    content = {
        "definitions": tf.VERSION,
        "config": {
            **values,
            "change_data": False,
        },  # not stored: it applies only to this start, after which `data` is the run's dataset
        "recipe": asdict(recipe),
        "data": dict(data),
    }
    write_json(config.out / CONFIG, content)


def read_config(run: Path) -> tuple[TrainConfig, dict[str, Any]]:
    """Read `config.json` in the folder `run`; returns the configuration and the description of the
    data.

    Raises ModelError when `config.json` is missing or damaged.
    """
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
        return TrainConfig(**values), shortened(content["data"])
    except (ValueError, KeyError, TypeError) as error:
        raise ModelError(f"{path} is damaged ({error!r}); start a new run") from error


def resume_config(run: Path, given: Mapping[str, Any]) -> tuple[TrainConfig, dict[str, Any]]:
    """Read the stored configuration of a run and change it by the fields `given` on the command
    line; returns the configuration and the description of the data.

    The fields `RESUMABLE_WITH` may change. With `change_data`, `hold_out_drives` and
    `skip_undecodable` may change too; for another folder as `data` they have their defaults unless
    given. Raises UserError when `given` changes another field.
    """
    stored, data = read_config(run)
    given = dict(given)
    if heads := given.pop("heads", None):
        given["network"] = with_heads(given.get("network", stored.network), heads)
    if stored.init and _is_run(given.get("init", stored.init), stored.init):
        given["init"] = stored.init
    free: tuple[str, ...] = RESUMABLE_WITH
    if given.get("change_data"):
        free += ABOUT_DATA
        if given.get("data", stored.data).resolve() != stored.data.resolve():
            given = {**{name: getattr(TrainConfig, name) for name in ABOUT_DATA}, **given}
    for name, value in given.items():
        kept = getattr(stored, name)
        if name not in free and value != kept:
            raise UserError(
                f"{run} was started with {name} {kept}, now {value} is given; leave it out to "
                "resume, or start a new run with another --out"
            )
    return replace(stored, **{k: v for k, v in given.items() if k in free}), data


def _is_run(name: str | Path, folder: str) -> bool:
    """Whether `name` names the model in `folder`, which need not exist any more."""
    with suppress(ModelError):
        name = resolve_run(name)
    return Path(name).resolve() == Path(folder).resolve()


def newest_run() -> Path:
    """Return the folder in `runs/` whose `config.json` was written last, when a run was started, or
    resumed with other options. Raises ModelError when there is none."""
    runs = [p.parent for p in RUNS.glob(f"*/{CONFIG}") if not p.parent.is_symlink()]
    if not runs:
        raise ModelError(f"there is no run in {RUNS}/ to resume; give its folder with --out")
    return max(runs, key=lambda run: (run / CONFIG).stat().st_mtime)
