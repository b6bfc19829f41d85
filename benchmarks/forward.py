"""Time of a forward pass: OpenVINO graph in bf16 and in int8, compared with torch in float32.

Each pass has one image and one thread. torch runs the published network channels-last, its fastest
float32 layout. The variants take turns, so that other load on the machine affects all of them
equally. The int8 graph is calibrated on noise: its outputs are useless, but it takes as long as any
int8 graph.

All variants compute the network's nine outputs. If the model has an uncertainty head, the variants
`with uncertainty` compute all outputs that `serve` needs.

    python benchmarks/forward.py [--model RUN] [--rounds 200] [--out FILE]
    claims: bf16 takes at most 0.40 of torch's time and int8 at most 0.20 of it; with uncertainty
    bf16 takes at most 0.40 of torch's time and int8 at most 0.25 of it
"""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

# numpy and torch read this variable when they are imported.
os.environ["OMP_NUM_THREADS"] = "1"

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.claims.outcome import conclude, run_command
from benchmarks.service_load.servers import model_copy
from mtlnet.export.int8 import quantise
from mtlnet.inference.engine import best_precision, openvino_core, read_graph
from mtlnet.inference.model_card import WEIGHTS, read_card
from mtlnet.model.network import load_network
from mtlnet.model.openvino_graph import build_graph

CLAIMS = {
    "bf16": 0.40,
    "int8": 0.20,
    "bf16 with uncertainty": 0.40,
    "int8 with uncertainty": 0.25,
}
WARM_UP = 20
Forward = Callable[[NDArray[np.uint8]], Any]


def torch_pass(run: Path) -> Forward:
    """Return a function that runs the torch network in float32, channels-last, on one thread."""
    torch.set_num_threads(1)
    network = load_network(run / WEIGHTS, read_card(run).network)
    network.to(memory_format=torch.channels_last)

    def forward(image: NDArray[np.uint8]) -> Any:
        with torch.inference_mode():
            return network.forward_heads(network.forward_features(torch.from_numpy(image[None])))

    return forward


def openvino_pass(
    run: Path, images: NDArray[np.uint8] | None, *, uncertainty: bool = False
) -> Forward:
    """Return a function that runs the OpenVINO graph of the model in `run` on one thread.

    The graph is in bf16, or in int8 if `images` (N, H, W, 3) are given to calibrate it. With
    `uncertainty` it computes all outputs that `serve` needs.
    """
    if uncertainty:
        graph = read_graph(run, read_card(run))
    else:
        graph = build_graph(load_network(run / WEIGHTS, read_card(run).network))
    if images is not None:
        graph = quantise(graph, images)
    options = {
        "INFERENCE_PRECISION_HINT": best_precision(),
        "INFERENCE_NUM_THREADS": 1,
        "NUM_STREAMS": 1,
        "ENABLE_CPU_PINNING": False,
    }
    request = openvino_core().compile_model(graph, "CPU", options).create_infer_request()
    return lambda image: request.infer([image[None]])


def measure(run: Path, rounds: int) -> dict[str, Any]:
    """Return the median times in ms over `rounds` passes of each variant, their ratios to torch's
    time, and whether the claims hold."""
    rng = np.random.default_rng(0)
    camera = read_card(run).camera
    images = rng.integers(0, 256, (16, camera.height, camera.width, 3), np.uint8)
    passes = {
        "torch f32": torch_pass(run),
        "bf16": openvino_pass(run, None),
        "int8": openvino_pass(run, images),
    }
    if read_card(run).uncertainty is not None:
        passes["bf16 with uncertainty"] = openvino_pass(run, None, uncertainty=True)
        passes["int8 with uncertainty"] = openvino_pass(run, images, uncertainty=True)
    times: dict[str, list[float]] = {name: [] for name in passes}
    for number in range(WARM_UP + rounds):
        for name, forward in passes.items():
            start = perf_counter()
            forward(images[number % len(images)])
            times[name].append(1e3 * (perf_counter() - start))
    medians = {name: median(found[WARM_UP:]) for name, found in times.items()}
    ratios = {name: found / medians["torch f32"] for name, found in medians.items()}
    held = all(ratio <= CLAIMS[name] for name, ratio in ratios.items() if name in CLAIMS)
    return {"median_ms": medians, "ratios": ratios, "claims": CLAIMS, "held": held}


def main(model: Path | None = None, rounds: int = 200, out: Path | None = None) -> None:
    with model_copy(model) as run_folder:
        result = measure(run_folder, rounds)
    conclude(result, out, result["held"])


if __name__ == "__main__":
    run_command(main)
