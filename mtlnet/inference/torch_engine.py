"""The reference engine, which runs the network in torch in float32.

This is the only module of `mtlnet.inference` that imports torch.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError

from mtlnet.inference.model_card import (
    UNCERTAINTY_WEIGHTS,
    WEIGHTS,
    ModelCard,
    ModelError,
    check_files,
)
from mtlnet.model.network import RUN_BATCH, load_network
from mtlnet.model.openvino_graph import build_graph
from mtlnet.model.served import ServedNetwork
from mtlnet.model.uncertainty_head import UncertaintyHead, load_uncertainty_head


class TorchEngine:
    """The network and its uncertainty head in float32, as a `mtlnet.inference.engine.Engine`."""

    kind = "torch"
    precision = "f32"

    def __init__(self, run: Path, card: ModelCard, threads: int = 1, *, gpu: bool = False) -> None:
        """Load the model in the folder `run`. `threads`: number of CPU threads of torch; `gpu`:
        compute on a GPU if there is one."""
        torch.set_num_threads(threads)
        self.card = card
        self.on_gpu = gpu and torch.cuda.is_available()
        self.served = load_served(run, card)
        if self.on_gpu:
            torch.backends.cudnn.allow_tf32 = False  # TF32, the default, rounds to 10 bits
            self.served.to("cuda")

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.card.check_image(image)
        result: NDArray[np.float32] = self.batch(image[None])[0]
        return result

    def batch(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Compute the outputs (B, K) for uint8 images (B, H, W, 3);
        `mtlnet.inference.prediction.split_outputs` explains the K columns."""
        device = next(self.served.parameters()).device
        with torch.inference_mode():
            parts = [
                self.served(torch.from_numpy(images[first : first + RUN_BATCH]).to(device)).cpu()
                for first in range(0, max(len(images), 1), RUN_BATCH)
            ]
        return torch.cat(parts).numpy()


def load_served(run: Path, card: ModelCard) -> ServedNetwork:
    """Load the network of a run, with its uncertainty head if the model has one. Raises ModelError
    when a file is missing or damaged."""
    has_head = card.uncertainty is not None
    check_files(run, card, (WEIGHTS, UNCERTAINTY_WEIGHTS) if has_head else (WEIGHTS,))
    head = read_uncertainty_head(run) if has_head else None
    return ServedNetwork(load_network(run / WEIGHTS, card.network), head).eval()


def convert_run(run: Path, card: ModelCard) -> Any:
    """Convert the weights of a run to an `openvino.Model` and return it. Raises ModelError when a
    file is missing or damaged."""
    served = load_served(run, card)
    return build_graph(served.network, served.head)


def read_uncertainty_head(run: Path) -> UncertaintyHead:
    """Load the uncertainty head of the model in the folder `run`. Raises ModelError if its file is
    damaged."""
    path = run / UNCERTAINTY_WEIGHTS
    try:
        return load_uncertainty_head(path)
    except (SafetensorError, KeyError, RuntimeError, OSError) as error:
        raise ModelError(f"{path} cannot be read ({error}); train the model again") from error
