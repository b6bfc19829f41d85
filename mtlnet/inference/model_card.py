"""Reads and writes the card of a trained model (`card.json`); finds and checks the folder of a run.

The folder of a run contains `card.json`, `config.json`, `model.safetensors` (the weights, batch
normalisation folded), `uncertainty.safetensors` (the uncertainty head), `model.xml` and `model.bin`
(the served graph, for OpenVINO), `curves.csv`, `checkpoints/` and `tensorboard/`.
"""

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.shipped_models import SHIPPED, SHIPPED_FILES
from mtlnet.inference.trained_rounds import shortened
from runtime.files import file_hash, write_json
from trackfeatures.camera import CameraParameters, stored
from trackfeatures.errors import UserError, require_version
from trackfeatures.names import require_name

RUNS = Path("runs")
CARD, WEIGHTS, GRAPH, GRAPH_WEIGHTS = "card.json", "model.safetensors", "model.xml", "model.bin"
UNCERTAINTY_WEIGHTS = "uncertainty.safetensors"
MODEL_FILES = (WEIGHTS, GRAPH, GRAPH_WEIGHTS)
# Additions by format: 2: `network`; 3: the uncertainty head; 4: the camera's pitch; 5:
# `uncertainty`; 6: short entries for the rounds.
FORMAT = 6
LISTING_FORMAT = 5
"""The earlier format that can still be read; its cards list every round."""


class ModelError(UserError):
    """Raised for a model that is missing, unfinished or damaged, or does not fit the image or the
    data."""


@dataclass(frozen=True)
class ModelCard:
    """Description of a trained model; the keys of `card.json`."""

    name: str
    network: str
    """A name of `mtlnet.architecture.ARCHITECTURES`."""
    definitions_version: str
    program_version: str
    camera: CameraParameters
    alpha: tuple[float, float, float]
    recipe: str
    iterations: int
    batch: int
    seed: int
    data: dict[str, Any]
    """Description of the training data (`mtlnet.data.description`)."""
    versions: dict[str, str]
    files: dict[str, str]
    """SHA-256 of each file, in hex."""
    export_check: dict[str, float]
    """Number of compared frames, and largest differences of the served graph from torch."""
    golden: tuple[float, ...]
    """Outputs (9,) of torch in float32 for the golden image (`mtlnet.inference.golden_image`)."""
    uncertainty: dict[str, Any] | None
    """Description of the fit of the uncertainty head; None for a model without this head."""

    @property
    def model_hash(self) -> str:
        """SHA-256 of the weights; part of every response of the service."""
        return self.files[WEIGHTS]

    def check_image(self, image: NDArray[np.uint8]) -> None:
        """Raise ModelError unless `image` is uint8 (H, W, 3) of the camera's size."""
        shape = (self.camera.height, self.camera.width, 3)
        if image.shape != shape or image.dtype != np.uint8:
            raise ModelError(
                f"the image is {image.dtype} of shape {image.shape}; this model takes uint8 RGB of "
                f"shape {shape} (height, width, 3): scale it first"
            )

    def write(self, run: Path) -> None:
        """Write `card.json` to the folder `run`, atomically."""
        content = {"format": FORMAT, "model_hash": self.model_hash}
        content |= asdict(self, dict_factory=stored)
        write_json(run / CARD, content)


def read_card(run: Path) -> ModelCard:
    """Read the card of the run in folder `run`.

    Raises ModelError when the card is missing, damaged or of an unknown format, or when a shipped
    model does not have the weights of this version of the program; DefinitionsMismatch for a model
    of another version of the track-feature definitions.
    """
    path = run / CARD
    if not run.is_dir():
        raise ModelError(f"there is no run folder {run}; train one with `mtlnet train --out {run}`")
    if not path.is_file():
        raise ModelError(
            f"{run} holds no finished model ({CARD} is missing); finish it with "
            f"`mtlnet train --out {run} --resume`"
        )
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        found = content["format"]
        if found not in (LISTING_FORMAT, FORMAT):
            raise ModelError(
                f"{path} has format {found}, this program reads {LISTING_FORMAT} and {FORMAT}; "
                "train anew"
            )
        values = {field.name: content[field.name] for field in fields(ModelCard)}
        values["camera"] = CameraParameters(**values["camera"])
        values["alpha"] = tuple(values["alpha"])
        values["golden"] = tuple(values["golden"])
        values["data"] = shortened(values["data"])
        if values["uncertainty"] is not None:
            values["uncertainty"] = shortened(values["uncertainty"])
        require_name(values["name"], "model's name")
        for name in values["files"]:
            require_name(name, "name of a model's file")
        card = ModelCard(**values)
    except (ValueError, KeyError, TypeError) as error:
        raise ModelError(f"{path} is damaged ({error!r}); train the model anew") from error
    require_version(card.definitions_version, f"the model in {run}")
    shipped = SHIPPED_FILES.get(run.name) if run.parent == SHIPPED.parent else None
    if shipped is not None and card.files != shipped:
        raise ModelError(f"{run} does not hold the weights of this version; install again")
    return card


def check_files(run: Path, card: ModelCard, names: tuple[str, ...]) -> None:
    """Raise ModelError unless each file in `names` exists in the folder `run` and has the hash that
    the card states."""
    for name in names:
        path = run / name
        if not path.is_file():
            raise ModelError(f"{path} is missing; train the model anew or restore the file")
        found = file_hash(path)
        if found != card.files.get(name):
            raise ModelError(
                f"{path} is damaged: its SHA-256 begins {found[:12]}, the card has "
                f"{str(card.files.get(name))[:12]}; train the model anew or restore the file"
            )


def resolve_run(name: str | Path, runs: Path = RUNS) -> Path:
    """Return the folder of a run. `name`: a path, a name in the folder `runs`, "latest", or the
    name of a shipped model.

    The shipped models are "default" and "varied" (for real roads). "default" stands for the latest
    run if no model is shipped. A folder or a run called "varied" has precedence over the shipped
    model. Symbolic links are resolved. Raises ModelError when there is no such run.
    """
    if str(name) == "default":
        if (SHIPPED / CARD).is_file():
            return SHIPPED
        return _latest(runs, "no weights are shipped with this version")
    if str(name) == "latest":
        return _latest(runs, "no run was made here")
    given = Path(name)
    for path in (given, runs / given):
        if path.is_dir():
            return path.resolve() if path.is_symlink() else path
    if str(name) in SHIPPED_FILES:
        return SHIPPED.parent / given
    raise ModelError(
        f"there is no run {name} (looked for {given} and {runs / given}); train one with `mtlnet "
        f"train`, or give the folder of a run or a shipped model ({', '.join(SHIPPED_FILES)})"
    )


def _latest(runs: Path, why: str) -> Path:
    latest = runs / "latest"
    if not latest.is_dir():
        raise ModelError(
            f"{why}, and there is no {latest}; train a model with `mtlnet train`, or give a run"
        )
    return latest.resolve()
