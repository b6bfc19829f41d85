"""`mtlnet ship --model RUN --out DIR`: writes a model at half the size.

The folder has `model.safetensors` in float16, the uncertainty head in float32, the served graph
with the same weights, and the card. Without OpenVINO no graph is written. The golden outputs in the
card are computed from the rounded weights. `write_page` adds a README.md with the results of
evaluations.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from numpy.typing import NDArray
from torch import Tensor

from mtlnet.architecture import HEIGHT, WIDTH
from mtlnet.evaluation.metrics import GROUPS
from mtlnet.export.publish import golden_outputs, write_model
from mtlnet.inference.engine import GATES, INT8, Engine, has_openvino, load_engine, read_export
from mtlnet.inference.golden_image import golden_image
from mtlnet.inference.model_card import (
    CARD,
    WEIGHTS,
    ModelCard,
    ModelError,
    read_card,
)
from mtlnet.inference.prediction import OUTPUTS
from mtlnet.inference.torch_engine import load_served
from mtlnet.inference.trained_rounds import Seeds
from mtlnet.model.network import load_network
from mtlnet.model.openvino_graph import TOLERANCE
from mtlnet.uncertainty_fit.head import refit_uncertainty_head
from runtime.files import atomic_write, require_other_file
from runtime.html import format_number, format_percent
from trackfeatures.errors import UserError
from trackfeatures.names import to_name

PAGE = "README.md"
PICTURE = "worst.jpg"
CHECK_IMAGES = 4
SHOWN = {"split", "frames", "rounds", "engine", "precision", "errors", "presence", *GROUPS}
"""Keys of an evaluation that the page shows."""


def ship_model(run: Path, out: Path, data: Path | None = None) -> dict[str, Any]:
    """Write the model of `run` to the folder `out`; returns the result of `--json`.

    `data`: a dataset on which the uncertainty head is fitted again (`refit_uncertainty_head`).
    Raises UserError when `out` has a model already, ModelError when the written graph differs from
    torch with the same weights by more than the tolerance. The difference from the unrounded model
    is only part of the result.
    """
    card = read_card(run)
    if (out / CARD).exists():
        raise UserError(f"{out} already holds a model; give another --out or delete it")
    refitted = None if data is None else refit_uncertainty_head(run, data)
    if refitted is not None:
        seeds = Seeds.read(card.data["seeds"]) | Seeds.read(refitted.about["seeds"])
        about = dict(refitted.about)
        tracks = sorted({*card.data["tracks"], *about.pop("tracks")})
        seen = {**card.data, "seeds": seeds.entry(), "tracks": tracks}
        card = replace(card, uncertainty=about, data=seen)
    served = load_served(run, replace(card, uncertainty=None) if refitted is not None else card)
    head = served.head if refitted is None else refitted.head
    halves = {name: half(name, t) for name, t in served.network.state_dict().items()}
    out.mkdir(parents=True, exist_ok=True)
    files = write_model(out, card.network, halves, head, narrow=True)
    shipped = replace(
        card,
        name=to_name(out.resolve().name),
        data=_without_folders(card.data),
        files=files,
        golden=golden_outputs(load_network(out / WEIGHTS, card.network)),
    )
    shipped.write(out)
    try:
        check = _check(run, out)
    except ModelError:
        (out / CARD).unlink()
        raise
    sizes = {name: (out / name).stat().st_size for name in (*files, CARD)}
    return {"model": shipped.name, "out": str(out), "files": sizes, "check": check}


def half(name: str, values: Tensor) -> Tensor:
    """Return the weights `values` in float16. Raises ModelError, with the tensor's `name`, when a
    weight is beyond the range of float16."""
    rounded = values.half()
    if not rounded.isfinite().all():
        raise ModelError(f"{name} holds a weight beyond float16's range: train the model anew")
    return rounded


def _without_folders(data: dict[str, Any]) -> dict[str, Any]:
    """Return the description of the training data with names instead of paths of datasets."""
    named = {**data, "path": Path(data["path"]).name}
    if "earlier" in data:
        named["earlier"] = [{**one, "path": Path(one["path"]).name} for one in data["earlier"]]
    return named


def _check(run: Path, out: Path) -> dict[str, float]:
    """Return the largest differences of the shipped graph's answers from torch's answers for the
    shipped weights, and from the run's answers. Raises ModelError for too large a difference.

    Without OpenVINO, torch's answers for the shipped weights are compared with the run's answers.
    """
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (CHECK_IMAGES, HEIGHT, WIDTH, 3), dtype=np.uint8)
    images = [golden_image(WIDTH, HEIGHT), *noise]
    torch, before = (_answers(load_engine(folder, "torch"), images) for folder in (out, run))
    if not has_openvino():
        return {"from_run_on_golden_image": float(np.abs(torch - before)[0].max())}
    graph = _answers(load_engine(out, "openvino", "f32"), images)
    found = {
        "from_torch": float(np.abs(graph - torch).max()),
        "from_run_on_golden_image": float(np.abs(graph - before)[0].max()),
    }
    if not found["from_torch"] <= TOLERANCE:
        raise ModelError(
            f"the answers of the weights in {out} differ from torch by "
            f"{found['from_torch']:.2g}, at most "
            f"{TOLERANCE:g} is expected; report this as a fault"
        )
    return found


def _answers(engine: Engine, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
    """Return the nine outputs of an engine for N images, (N, 9)."""
    return np.stack([engine(image)[:OUTPUTS] for image in images])


def write_page(
    model: Path,
    evaluations: Sequence[Path],
    notes: Path | None = None,
    picture: Path | None = None,
) -> Path:
    """Write `README.md` to the model's folder: its card, the text of `notes`, the result of its
    int8 graph's accuracy gate, if it has one, and the tables of evaluations; returns the file.

    `evaluations`: files with the output of `mtlnet evaluate --json`; `notes`: a Markdown file;
    `picture`: a JPEG of the worst frames, which is copied to the folder. Raises UserError for an
    evaluation that is unreadable or of another model, for notes that are not UTF-8, and if one of
    these files would be replaced.
    """
    out = model / PAGE
    require_other_file(out, [*evaluations, *(path for path in (notes, picture) if path)])
    card, int8 = read_card(model), read_export(model / INT8) or {}
    found = [_read_evaluation(path, card) for path in evaluations]
    tracks = [name for name in card.data["tracks"] if not name.startswith("random:")]
    environment = Environment(
        loader=PackageLoader("mtlnet.export", ""), undefined=StrictUndefined, autoescape=False
    )
    page = environment.get_template("model_page.md").render(
        card=card,
        tracks=tracks,
        random_roads=len(card.data["tracks"]) - len(tracks),
        notes="" if notes is None else _read_notes(notes),
        gates=[int8[key] for key in GATES if int8.get(key)]
        if int8.get("model_hash") == card.model_hash
        else [],
        evaluations=found,
        averaged=any(one.get("views", 1) > 1 for one in found),
        picture=PICTURE if picture is not None else "",
        groups=GROUPS,
        number=format_number,
        percent=format_percent,
    )
    if picture is not None:
        atomic_write(model / PICTURE, picture.read_bytes())
    atomic_write(out, page)
    return out


def check_page_options(
    model: str,
    data: Path | None,
    evaluations: Sequence[Path] | None,
    notes: Path | None,
    picture: Path | None,
) -> None:
    """Raise UserError for options of `mtlnet ship` that would have no effect."""
    if not evaluations and (notes is not None or picture is not None):
        raise UserError("--notes and --picture belong to --evaluation; give it too, or leave both")
    if evaluations and (model != "default" or data is not None):
        raise UserError(
            "--evaluation writes README.md for the model in --out; leave --model and --data out"
        )


def _read_notes(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8").strip()
    except UnicodeDecodeError as error:
        raise UserError(f"--notes {path} is not UTF-8 ({error}); save it as UTF-8") from error


def _read_evaluation(path: Path, card: ModelCard) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if found["model_hash"] != card.model_hash:
            raise UserError(f"{path} evaluates {found['model']}, other weights than these")
        if "pictures" in found:
            raise UserError(
                f"{path} evaluates pictures of your own; the page shows evaluations on recorded "
                "rounds: give the output of `mtlnet evaluate --json` for a dataset"
            )
        if missing := SHOWN - found.keys():
            raise KeyError(min(missing))
        return found
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is no result of `mtlnet evaluate --json` ({error!r})") from error
