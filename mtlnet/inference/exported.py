"""What `mtlnet export` leaves beside a model: `export/FORMAT-PRECISION/` with `export.json`.

Free of torch: the engine finds the int8 graph here, and whether it passed the accuracy gate. An
int8 graph is what an engine takes by default only where its gate, judged on test rounds against
float32, says so (DESIGN section 7).
"""

import json
from pathlib import Path
from typing import Any

from mtlnet.inference.model_card import GRAPH, GRAPH_WEIGHTS, ModelCard, ModelError, file_hash
from runtime.files import atomic_write

ABOUT = "export.json"
INT8 = Path("export") / "openvino-int8"
LIMITS = {"distance_m": 0.003, "angle_rad": 0.0002, "accuracy": 0.001}
"""How much worse than float32 a faster model may be: m, rad, share of the frames."""


def gate(exact: dict[str, Any], rounded: dict[str, Any]) -> dict[str, Any]:
    """Judge a model by its evaluation and that in float32, of the same frames.

    {"passed", "frames", "split", "worse": {name: by how much}}; every marking and the offset from
    the lane centre are held to the limit of a distance. What no label tells is not judged.
    """
    pairs = {
        **{name: (exact["mae_m"][name], value) for name, value in rounded["mae_m"].items()},
        "to_lane_centre": (exact["to_lane_centre_mae_m"], rounded["to_lane_centre_mae_m"]),
        "angle": (exact["angle_mae_rad"], rounded["angle_mae_rad"]),
        "accuracy": (rounded["heading_accuracy"], exact["heading_accuracy"]),
    }
    worse = {
        name: after - before
        for name, (before, after) in pairs.items()
        if before is not None and after is not None
    }
    lost = [name for name, pair in pairs.items() if (pair[0] is None) != (pair[1] is None)]
    limits = {"angle": LIMITS["angle_rad"], "accuracy": LIMITS["accuracy"]}
    # Written so that a NaN fails.
    failed = [
        name for name, by in worse.items() if not by <= limits.get(name, LIMITS["distance_m"])
    ]
    return {
        "passed": not failed and not lost and bool(worse),
        "failed": failed + lost,
        "split": exact["split"],
        "frames": exact["frames"],
        "limits": LIMITS,
        "worse": worse,
    }


def write_about(folder: Path, card: ModelCard, names: tuple[str, ...], **about: Any) -> None:
    """Write `export.json` of the export in `folder`, with the hashes of the files it is for."""
    files = {name: file_hash(folder / name) for name in names}
    content = {"model_hash": card.model_hash, "files": files, **about}
    atomic_write(folder / ABOUT, (json.dumps(content, indent=1) + "\n").encode(), fsync=True)


def read_about(folder: Path) -> dict[str, Any] | None:
    """The `export.json` of a folder, None where there is none; ModelError when it is damaged."""
    path = folder / ABOUT
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content["files"], dict) or "model_hash" not in content:
            raise TypeError("not what an export writes")
    except (ValueError, KeyError, TypeError) as error:
        raise ModelError(f"{path} is damaged ({error!r}); delete it or export anew") from error
    return dict(content)


def passed_gate(run: Path, card: ModelCard) -> bool:
    """Whether the run has an int8 graph of these very weights that passed the accuracy gate."""
    about = read_about(run / INT8)
    if about is None or about["model_hash"] != card.model_hash:
        return False
    return bool((about.get("gate") or {}).get("passed"))


def int8_graph(run: Path, card: ModelCard) -> Path:
    """The int8 graph of a run; ModelError where there is none, or of other weights, or damaged."""
    folder = run / INT8
    about = read_about(folder)
    how = f"make it with `mtlnet export --model {run} --format openvino --precision int8`"
    if about is None:
        raise ModelError(f"{run} has no int8 graph; {how}")
    if about["model_hash"] != card.model_hash:
        raise ModelError(f"{folder} was made from other weights than those of {run}; {how}")
    for name in (GRAPH, GRAPH_WEIGHTS):
        path = folder / name
        if not path.is_file() or file_hash(path) != about["files"].get(name):
            raise ModelError(f"{path} is missing or damaged; {how}")
    return folder / GRAPH
