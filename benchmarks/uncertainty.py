"""Processor time that the uncertainty head adds to a forward pass, for two forms of its textures.

One image, one thread, the engine's precision. The graph without the head, with the head, and with
the head on textures computed plane by plane (`direct_textures`, the form before) run in turns. All
times are processor times of this process, which other load changes little.

    python benchmarks/uncertainty.py [--model RUN] [--rounds 300] [--out FILE]
    claim: the head adds at most 0.85 of what it adds with the textures plane by plane
"""

import os
import sys
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any
from unittest.mock import patch

# Set before numpy and torch are imported, which read it then.
os.environ["OMP_NUM_THREADS"] = "1"

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from torch import Tensor, cat
from torch.nn.functional import pad

from benchmarks.claims.outcome import conclude, run_command
from mtlnet.inference.engine import best_precision, openvino_core
from mtlnet.inference.model_card import SHIPPED, read_card
from mtlnet.inference.torch_engine import load_served
from mtlnet.model import textures
from mtlnet.model.openvino_graph import build_graph

CLAIM = 0.85
WARM_UP = 20


def direct_sums(images: Tensor) -> tuple[Tensor, int]:
    """`mtlnet.model.textures.band_sums`, plane by plane: differences first, then sums of bands."""
    colours = images.permute(0, 3, 1, 2)
    red, green, blue = (colours[:, k : k + 1].float() for k in range(3))
    grey = red + green + blue
    across = (pad(grey, (0, 1, 0, 0), mode="replicate")[..., 1:] - grey).abs()
    down = (pad(grey, (0, 0, 0, 1), mode="replicate")[:, :, 1:] - grey).abs()
    bands, columns = textures.CELL_ROWS * textures.BANDS, textures.CELL_COLUMNS
    sums = []
    for plane in (colours.float(), across, down):
        count, height, width = (int(size) for size in plane.shape[1:])
        rows = plane.reshape(-1, count, bands, height // bands, width).sum(3)
        sums.append(rows.reshape(-1, count, bands, columns, width // columns).sum(4))
    return cat(sums, 1), height // bands * (width // columns)


def measure(run: Path, rounds: int) -> dict[str, Any]:
    """Median processor times in ms, and what the head adds in each form."""
    card = read_card(run)
    served = load_served(run, card)
    graphs = {
        "without": build_graph(served.network),
        "with": build_graph(served.network, served.head),
    }
    with patch.object(textures, "band_sums", direct_sums):
        graphs["plane by plane"] = build_graph(served.network, served.head)
    options = {
        "INFERENCE_PRECISION_HINT": best_precision(),
        "INFERENCE_NUM_THREADS": 1,
        "NUM_STREAMS": 1,
        "ENABLE_CPU_PINNING": False,
    }
    requests = {
        name: openvino_core().compile_model(graph, "CPU", options).create_infer_request()
        for name, graph in graphs.items()
    }
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (16, card.camera.height, card.camera.width, 3), np.uint8)
    times: dict[str, list[float]] = {name: [] for name in requests}
    for number in range(WARM_UP + rounds):
        for name, request in requests.items():
            start = process_time()
            request.infer([images[number % len(images)][None]])
            times[name].append(1e3 * (process_time() - start))
    found = {name: median(values[WARM_UP:]) for name, values in times.items()}
    added = {name: found[name] - found["without"] for name in ("with", "plane by plane")}
    ratio = added["with"] / added["plane by plane"]
    return {"processor_ms": found, "added_ms": added, "ratio": ratio, "claim": CLAIM}


def main(model: Path = SHIPPED, rounds: int = 300, out: Path | None = None) -> None:
    result = measure(model, rounds)
    conclude(result, out, result["ratio"] <= CLAIM)


if __name__ == "__main__":
    run_command(main)
