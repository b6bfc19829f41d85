"""Runs a network on frames for the fit of its uncertainty head: the inputs of the head, and the
errors whose standard deviations it predicts."""

import copy
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.recording import Frames
from mtlnet.architecture import HEIGHT, WIDTH
from mtlnet.data.loader import Images
from mtlnet.data.model_labels import model_labels
from mtlnet.evaluation.metrics import signed_errors
from mtlnet.inference.engine import best_precision, has_openvino, openvino_core
from mtlnet.inference.prediction import OUTPUTS
from mtlnet.model.network import Network
from mtlnet.model.openvino_graph import build_feature_graph
from mtlnet.model.served import FitInputs
from mtlnet.model.textures import TEXTURE_VALUES, light_features

CHUNK = 32  # images read at once


@dataclass(frozen=True)
class FrameOutputs:
    """Results of a frozen network on N frames: inputs `x` (N, F) of the uncertainty head, of which
    the last ten are the light features, `error` (N, 7) in m and rad, and texture features `texture`
    (N, 1040).

    An error is NaN where the label is absent or unknown; the error of `to_lane_centre` is also NaN
    where the prediction is absent.
    """

    x: NDArray[np.float32]  # (N, F) inputs of the uncertainty head, light features last
    error: NDArray[np.float32]  # (N, D) m and rad
    texture: NDArray[np.float32]  # (N, T)


def run_on_frames(network: Network, frames: Images, limit: int) -> FrameOutputs:
    """Run `network` on up to `limit` evenly spaced frames, and return the results that the fit of
    the uncertainty head needs.

    If OpenVINO is installed, OpenVINO runs the network, in bf16 on a CPU that supports bf16
    natively, else in float32. Without OpenVINO, torch runs it in float32.
    """
    chosen = np.linspace(0, len(frames) - 1, min(limit, len(frames))).astype(np.int64)
    run = _run_openvino if has_openvino() else _run_torch
    outputs, x, textures = run(network, frames, chosen)
    labels = model_labels(frames) if isinstance(frames, Frames) else frames.labels
    error = signed_errors(outputs, labels.distances[chosen], labels.angle[chosen])
    x = np.concatenate([x, light_features(torch.from_numpy(textures)).numpy()], 1)
    return FrameOutputs(x, error.astype(np.float32), textures)


def _run_torch(
    network: Network, frames: Images, chosen: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return the same arrays as `_run_openvino`, computed by torch in float32, on a GPU if there is
    one."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    torch.backends.cudnn.allow_tf32 = False  # TF32, the default, rounds to 10 bits
    module = FitInputs(copy.deepcopy(network)).eval().to(device)
    images = np.empty((CHUNK, HEIGHT, WIDTH, 3), np.uint8)
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    with torch.inference_mode():
        for first in range(0, len(chosen), CHUNK):
            rows = chosen[first : first + CHUNK]
            found = frames.read_batch(rows, images[: len(rows)])
            parts.append(module(torch.from_numpy(found).to(device)))
    outputs, x, textures = (torch.cat(each).cpu().numpy() for each in zip(*parts, strict=True))
    return outputs, x, textures


def _run_openvino(
    network: Network, frames: Images, chosen: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return the network's outputs (N, 9), the inputs of the uncertainty head without the light
    features (N, F), and the texture features (N, 1040), for the N frames with the indices `chosen`.

    One OpenVINO request per core computes these arrays, three times as fast as torch in float32.
    """
    x = np.empty((len(chosen), network.architecture.uncertainty_inputs), np.float32)
    outputs = np.empty((len(chosen), OUTPUTS), np.float32)
    textures = np.empty((len(chosen), TEXTURE_VALUES), np.float32)

    def store(request: Any, row: int) -> None:
        for number, values in enumerate((outputs, x, textures)):
            values[row] = request.get_output_tensor(number).data[0]

    queue = _infer_queue(network)
    queue.set_callback(store)
    images = np.empty((CHUNK, HEIGHT, WIDTH, 3), np.uint8)
    for first in range(0, len(chosen), CHUNK):
        rows = chosen[first : first + CHUNK]
        for row, image in enumerate(frames.read_batch(rows, images[: len(rows)])):
            queue.start_async([image[None].copy()], first + row)
        queue.wait_all()
    return outputs, x, textures


def _infer_queue(network: Network) -> Any:
    """Return a queue of OpenVINO requests: one per core, each with one thread."""
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
