"""Runs a network on frames, for the fit of its uncertainty head: the head's inputs, and the errors
whose standard deviations it predicts."""

import copy
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from datagen.recording import Frames
from mtlnet.data.loader import Images
from mtlnet.data.model_labels import model_labels
from mtlnet.evaluation.metrics import signed_errors
from mtlnet.export.openvino_graph import build_feature_graph
from mtlnet.inference.engine import best_precision, has_openvino, openvino_core
from mtlnet.inference.prediction import OUTPUTS
from mtlnet.inference.uncertainty import TEXTURE_VALUES, light_features, texture_features
from mtlnet.model.architecture import HEIGHT, WIDTH
from mtlnet.model.network import Network, run_network

CHUNK = 32  # images read at once

Numbers = NDArray[np.float32]


@dataclass(frozen=True)
class FrameOutputs:
    """A frozen network's results on N frames.

    An error is NaN where the label or, for `to_lane_centre`, the prediction is absent.
    """

    x: Numbers  # (N, F) what the standard deviations are predicted from, the light included
    error: Numbers  # (N, D) m and rad
    texture: Numbers  # (N, T)


def run_on_frames(network: Network, frames: Images, limit: int) -> FrameOutputs:
    """Run `network` on up to `limit` evenly spaced frames.

    By OpenVINO in the precision of the engine, where it is installed, else by torch in float32.
    """
    chosen = np.linspace(0, len(frames) - 1, min(limit, len(frames))).astype(np.int64)
    run = _run_openvino if has_openvino() else _run_torch
    x, outputs, textures = run(network, frames, chosen)
    labels = model_labels(frames) if isinstance(frames, Frames) else frames.labels
    error = signed_errors(outputs, labels.distances[chosen], labels.angle[chosen])
    x = np.concatenate([x, light_features(textures)], 1)
    return FrameOutputs(x, error.astype(np.float32), textures)


def _run_torch(
    network: Network, frames: Images, chosen: NDArray[np.int64]
) -> tuple[Numbers, Numbers, Numbers]:
    """Computes what `_run_openvino` returns by torch in float32, on a GPU where there is one."""
    moved = copy.deepcopy(network).to("cuda" if torch.cuda.is_available() else "cpu")
    images = np.empty((CHUNK, HEIGHT, WIDTH, 3), np.uint8)
    parts: list[tuple[Numbers, Numbers, Numbers]] = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for first in range(0, len(chosen), CHUNK):
            rows = chosen[first : first + CHUNK]
            found = frames.read_batch(rows, images[: len(rows)])
            answers = run_network(moved, found)
            textures = np.stack(list(pool.map(texture_features, found)))
            parts.append((answers.uncertainty_inputs, answers.outputs, textures))
    x, outputs, textures = (np.concatenate(each) for each in zip(*parts, strict=True))
    return x, outputs, textures


def _run_openvino(
    network: Network, frames: Images, chosen: NDArray[np.int64]
) -> tuple[Numbers, Numbers, Numbers]:
    """The network's inputs of the head (N, F), its outputs (N, 9) and the textures (N, T).

    With one request a core: three times as fast as torch in float32.
    """
    x = np.empty((len(chosen), network.architecture.uncertainty_inputs), np.float32)
    outputs = np.empty((len(chosen), OUTPUTS), np.float32)
    textures = np.empty((len(chosen), TEXTURE_VALUES), np.float32)

    def store(request: Any, row: int) -> None:
        outputs[row] = request.get_output_tensor(0).data[0]
        x[row] = request.get_output_tensor(1).data[0]

    queue = _infer_queue(network)
    queue.set_callback(store)
    images = np.empty((CHUNK, HEIGHT, WIDTH, 3), np.uint8)
    for first in range(0, len(chosen), CHUNK):
        rows = chosen[first : first + CHUNK]
        for row, image in enumerate(frames.read_batch(rows, images[: len(rows)])):
            queue.start_async([image[None].copy()], first + row)
            textures[first + row] = texture_features(image)
        queue.wait_all()
    return x, outputs, textures


def _infer_queue(network: Network) -> Any:
    """As many parallel requests as there are cores, of one thread each."""
    import openvino

    cores = os.cpu_count() or 1
    options = {
        "INFERENCE_PRECISION_HINT": best_precision(),
        "INFERENCE_NUM_THREADS": cores,
        "NUM_STREAMS": cores,
        "ENABLE_CPU_PINNING": False,
    }
    compiled = openvino_core().compile_model(build_feature_graph(network), "CPU", options)
    return openvino.AsyncInferQueue(compiled)
