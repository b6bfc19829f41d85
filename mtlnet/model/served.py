"""The served network, which computes all outputs of a model from uint8 images.

This module is the only definition of the served computation. The torch engine runs it, and the
OpenVINO graph is converted from it (`mtlnet.model.openvino_graph`).
"""

import torch
from torch import Tensor, nn

from mtlnet.model.network import Network
from mtlnet.model.textures import texture_features
from mtlnet.model.uncertainty_head import UncertaintyHead


class ServedNetwork(nn.Module):
    """A folded network with the softmax of its classes, and its uncertainty head if it has one.

    It maps uint8 images (B, 210, 280, 3) to float32 (B, K): nine outputs, then 8 columns of the
    uncertainty head and 5 probabilities of absence where the model has them
    (`mtlnet.inference.prediction.split_outputs`).
    """

    def __init__(self, network: Network, head: UncertaintyHead | None = None) -> None:
        super().__init__()
        self.network, self.head = network, head

    def forward(self, images: Tensor) -> Tensor:
        x = self.network.forward_features(images)
        parts = [self.network.nine_outputs(x)]
        if self.head is not None:
            parts.append(self.head(self.network.uncertainty_inputs(x), texture_features(images)))
        if self.network.architecture.bins:
            parts.append(self.network.absent_probabilities(x))
        return torch.cat(parts, 1)


class FitInputs(ServedNetwork):
    """Computes the data on which the uncertainty head is fitted, from uint8 images
    (B, 210, 280, 3): the nine outputs (B, 9), the inputs of the head that come from the network
    (B, 256 or 262), and the texture features (B, 1040) of `mtlnet.model.textures`."""

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # type: ignore[override]
        x = self.network.forward_features(images)
        outputs, inputs = self.network.nine_outputs(x), self.network.uncertainty_inputs(x)
        return outputs, inputs, texture_features(images)
