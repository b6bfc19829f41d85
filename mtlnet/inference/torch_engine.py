"""The reference engine: the network in torch, float32, with which the exported graph is compared.

The only module of `mtlnet.inference` that imports torch.
"""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from mtlnet.inference.model_card import UNCERTAINTY_WEIGHTS, WEIGHTS, ModelCard, check_files
from mtlnet.inference.uncertainty import read_uncertainty_head, texture_features
from mtlnet.model.network import load_network, run_network


class TorchEngine:
    """The network and its uncertainty head in float32, as a `mtlnet.inference.engine.Engine`."""

    kind = "torch"
    precision = "f32"

    def __init__(self, run: Path, card: ModelCard, threads: int = 1, *, gpu: bool = False) -> None:
        """`gpu`: compute on a GPU if there is one."""
        has_head = card.uncertainty is not None
        check_files(run, card, (WEIGHTS, UNCERTAINTY_WEIGHTS) if has_head else (WEIGHTS,))
        torch.set_num_threads(threads)
        self.card = card
        self.on_gpu = gpu and torch.cuda.is_available()
        self._network = load_network(run / WEIGHTS, card.network)
        if self.on_gpu:
            torch.backends.cudnn.allow_tf32 = False  # TF32, the default, rounds to 10 bits
            self._network.to("cuda")
        self._head = read_uncertainty_head(run) if has_head else None

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.card.check_image(image)
        result: NDArray[np.float32] = self.batch(image[None])[0]
        return result

    def batch(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Outputs (B, 9) to (B, 22) for images (B, H, W, 3)."""
        answers = run_network(self._network, images)
        parts = [answers.outputs]
        if self._head is not None:
            textures = np.stack([texture_features(image) for image in images])
            parts.append(self._head.predict(answers.uncertainty_inputs, textures))
        return np.concatenate([*parts, answers.absent], 1)
