"""The card of a trained model: what it was made from and for, and where its folder is.

Free of torch: the service reads cards. A run's folder holds `card.json`, `config.json`,
`model.safetensors` (the folded weights of the network), `doubt.safetensors` (the second head that
says how sure an answer is), `model.xml` and `model.bin` (both for OpenVINO), `curves.csv`,
`checkpoints/` and `tensorboard/`.
"""

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.files import atomic_write
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError, require_version

RUNS = Path("runs")
SHIPPED = Path(__file__).parents[1] / "weights" / "default"
CARD, WEIGHTS, GRAPH, GRAPH_WEIGHTS = "card.json", "model.safetensors", "model.xml", "model.bin"
UNCERTAINTY_WEIGHTS = "doubt.safetensors"
MODEL_FILES = (WEIGHTS, GRAPH, GRAPH_WEIGHTS)
FORMAT = 4  # 2: `network`; 3: `doubt`; 4: how the camera is aimed


class ModelError(UserError):
    """A model that is missing, unfinished, damaged or not for this image."""


@dataclass(frozen=True)
class ModelCard:
    """What a model is. `files` are SHA-256 in hex; `data` describes the dataset it learned from."""

    name: str
    network: str  # of `mtlnet.model.architecture.ARCHITECTURES`
    definitions_version: str
    program_version: str
    camera: CameraParameters
    alpha: tuple[float, float, float]
    recipe: str
    iterations: int
    batch: int
    seed: int
    data: dict[str, Any]
    versions: dict[str, str]
    files: dict[str, str]
    export_check: dict[str, float]
    golden: tuple[
        float, ...
    ]  # what torch in float32 answers to `mtlnet.inference.model_card.golden_image`, (9,)
    doubt: dict[str, Any] | None  # how its standard deviations were fitted; None: it gives none

    @property
    def model_hash(self) -> str:
        """The hash that names these weights in every answer."""
        return self.files[WEIGHTS]

    def write(self, run: Path) -> None:
        """Write `card.json`, whole or not at all."""
        text = json.dumps(
            {"format": FORMAT, "model_hash": self.model_hash, **asdict(self)}, indent=1
        )
        atomic_write(run / CARD, f"{text}\n".encode(), fsync=True)


def read_card(run: Path) -> ModelCard:
    """The card of the run in folder `run`.

    Raises ModelError when it is missing or unreadable, DefinitionsMismatch when it was trained
    on another version of the track-feature definitions.
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
        if found != FORMAT:
            raise ModelError(f"{path} has format {found}, this program reads {FORMAT}; train anew")
        values = {field.name: content[field.name] for field in fields(ModelCard)}
        values["camera"] = CameraParameters(**values["camera"])
        values["alpha"] = tuple(values["alpha"])
        values["golden"] = tuple(values["golden"])
        card = ModelCard(**values)
    except (ValueError, KeyError, TypeError) as error:
        raise ModelError(f"{path} is damaged ({error!r}); train the model anew") from error
    require_version(card.definitions_version, f"the model in {run}")
    return card


def check_files(run: Path, card: ModelCard, names: tuple[str, ...]) -> None:
    """Raise ModelError unless the named files of `run` are those the card was written for."""
    for name in names:
        path = run / name
        if not path.is_file():
            raise ModelError(f"{path} is missing; train the model anew or restore the file")
        found = file_hash(path)
        if found != card.files.get(name):
            raise ModelError(
                f"{path} is damaged: its SHA-256 begins {found[:12]}, the card says "
                f"{str(card.files.get(name))[:12]}; train the model anew or restore the file"
            )


def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def resolve_run(name: str | Path, runs: Path = RUNS) -> Path:
    """The folder of a run given as a path, a name in `runs/`, "latest" or "default".

    "default" is the model shipped with the project or, while there is none, the latest run. The
    result names the folder really meant (links resolved), so that a command can say which.
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
    raise ModelError(
        f"there is no run {name} (looked for {given} and {runs / given}); train one "
        "with `mtlnet train`, or give the folder of a run"
    )


def _latest(runs: Path, why: str) -> Path:
    latest = runs / "latest"
    if not latest.is_dir():
        raise ModelError(
            f"{why}, and there is no {latest}; train a model with `mtlnet train`, or give a run"
        )
    return latest.resolve()


# One image every model has answered before it was published: the service asks it again at start.
# Free of torch. Drawn in integers, so that it has the same bits on every machine.


SKY, GRASS, ASPHALT, PAINT = (150, 180, 220), (70, 110, 60), (95, 95, 100), (230, 230, 225)


def golden_image(width: int, height: int) -> NDArray[np.uint8]:
    """A straight one-lane road under a clear sky, uint8 RGB (height, width, 3)."""
    image = np.empty((height, width, 3), np.uint8)
    horizon = height // 2
    image[:horizon] = SKY
    image[horizon:] = GRASS
    # Twice the offset from the middle column, and the road's half width in that row: it grows
    # linearly from the horizon down, as a flat road's does.
    offset = np.abs(2 * np.arange(width) - (width - 1))[None, :]
    depth = np.arange(1, height - horizon + 1)[:, None]
    half_width = depth * 5 * width // (3 * (height - horizon))
    road = image[horizon:]
    road[offset <= half_width] = ASPHALT
    painted = (offset <= half_width * 8 // 10) & (offset >= half_width * 76 // 100)
    road[painted] = PAINT
    return image
