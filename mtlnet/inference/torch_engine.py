"""The reference engine: the network in torch, float32. The exported graph is compared with it.

The only module of `mtlnet.inference` that imports torch.
"""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from mtlnet.inference.engine import Precision, check_image
from mtlnet.inference.model_card import UNCERTAINTY_WEIGHTS, WEIGHTS, ModelCard, check_files
from mtlnet.inference.uncertainty import read_uncertainty_head, texture_features
from mtlnet.model.network import load_network, run_network


class TorchEngine:
    """The network and its uncertainty head in float32; see `mtlnet.inference.engine.Engine`."""

    kind = "torch"

    def __init__(self, run: Path, card: ModelCard, threads: int = 1) -> None:
        has_head = card.uncertainty is not None
        check_files(run, card, (WEIGHTS, UNCERTAINTY_WEIGHTS) if has_head else (WEIGHTS,))
        torch.set_num_threads(threads)
        self.card = card
        self.precision: Precision = "f32"
        self._network = load_network(run / WEIGHTS, card.network)
        self._head = read_uncertainty_head(run) if has_head else None
        self._shape = (card.camera.height, card.camera.width, 3)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        check_image(image, self._shape)
        answers = run_network(self._network, image[None])
        parts = [answers.outputs]
        if self._head is not None:
            textures = texture_features(image)[None]
            parts.append(self._head.predict(answers.uncertainty_inputs, textures))
        result: NDArray[np.float32] = np.concatenate([*parts, answers.absent], 1)[0]
        return result
