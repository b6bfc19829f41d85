"""Reading `export/FORMAT-PRECISION/export.json`, which `mtlnet export` writes beside a model.

The engine uses an int8 graph by default only if `export.json` records that the graph passed its
accuracy gate (`mtlnet.export.int8`; DESIGN section 7).
"""

import json
from pathlib import Path
from typing import Any

from mtlnet.inference.model_card import GRAPH, GRAPH_WEIGHTS, ModelCard, ModelError, file_hash

EXPORT_FILE = "export.json"
INT8 = Path("export") / "openvino-int8"


def read_export(folder: Path) -> dict[str, Any] | None:
    """The `export.json` of a folder, None if there is none; ModelError when it is damaged."""
    path = folder / EXPORT_FILE
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content["files"], dict) or "model_hash" not in content:
            raise TypeError("no files or no model_hash")
    except (ValueError, KeyError, TypeError) as error:
        raise ModelError(f"{path} is damaged ({error!r}); delete it or export again") from error
    return dict(content)


def passed_gate(run: Path, card: ModelCard) -> bool:
    """Whether the run has an int8 graph of the card's weights that passed the accuracy gate."""
    about = read_export(run / INT8)
    if about is None or about["model_hash"] != card.model_hash:
        return False
    return bool((about.get("gate") or {}).get("passed"))


def int8_graph(run: Path, card: ModelCard) -> Path:
    """Path of a run's int8 graph; ModelError if missing, damaged or made from other weights."""
    folder = run / INT8
    about = read_export(folder)
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
