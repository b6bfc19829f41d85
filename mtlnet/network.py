"""The multi-task network of the paper (section IV-C), and others in its place: `mtlnet.plan`.

Input: uint8 RGB images (B, 210, 280, 3). Output (B, 9): five coded distances and the coded angle
(linear), and the scores of the classes left, straight, right (before softmax). Recipe `fast`
trains a rescaled form of it, with batch normalisation after every convolution, and
heads that answer in standard deviations; `fold` turns that into the paper's network, exactly.
"""

import copy
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file
from torch import Tensor, nn

from mtlnet.layers import block, build_features, fold_norms
from mtlnet.plan import HEADS, HEIGHT, MTL, WIDTH, Plan, find_plan

__all__ = [
    "HEIGHT",
    "WIDTH",
    "Network",
    "answer_images",
    "describe_images",
    "fold",
    "initialise",
    "load_network",
]


class Network(nn.Module):
    """The network; with `batch_norm` and other `target_*`, the form that recipe `fast` trains."""

    target_mean: Tensor
    target_std: Tensor

    def __init__(self, *, batch_norm: bool = False, dropout: float = 0.0, plan: Plan = MTL) -> None:
        super().__init__()
        self.plan = plan
        self.features, size = build_features(plan, batch_norm=batch_norm)
        self.shared = nn.Sequential()
        for number, units in enumerate(plan.shared):
            # Not normalised: what neighbours in a batch add to an image is noise to a distance.
            self.shared.add_module(f"fc{number}", block(nn.Linear(size, units), None, dropout))
            size = units
        self.heads = nn.ModuleDict({name: nn.Linear(size, units) for name, units in HEADS})
        # Heads answer in these units; (0, 1), the paper's, unless recipe `fast` sets others.
        self.register_buffer("target_mean", torch.zeros(6), persistent=batch_norm)
        self.register_buffer("target_std", torch.ones(6), persistent=batch_norm)

    def forward(self, images: Tensor) -> Tensor:
        """Images (B, 210, 280, 3), uint8 or already normalised float -> (B, 9) float32."""
        return self.answer(self.describe(images))

    def describe(self, images: Tensor) -> Tensor:
        """The last shared features (B, 256) of images, from which the heads answer."""
        x = (normalise(images) if images.dtype == torch.uint8 else images).permute(0, 3, 1, 2)
        described: Tensor = self.shared(self.features(x).flatten(1))
        return described

    def answer(self, x: Tensor) -> Tensor:
        """The outputs (B, 9) for last shared features (B, 256)."""
        # The heads are small: in float32 also under autocast, for coded values near each other.
        with torch.autocast(x.device.type, enabled=False):
            x = x.float()
            coded = torch.cat([self.heads["distance"](x), self.heads["angle"](x)], 1)
            return torch.cat(
                [coded * self.target_std + self.target_mean, self.heads["heading"](x)], 1
            )


def normalise(images: Tensor) -> Tensor:
    """uint8 colours -> float32 in [-1, 1]; the exported graph does the same."""
    return images.float() * (1 / 127.5) - 1.0


def initialise(network: Network, seed: int) -> None:
    """He's normal initialisation for layers before a ReLU, small heads; same seed, same weights."""
    generator = torch.Generator().manual_seed(seed)
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv2d | nn.Linear):
            gain = 0.01 if name.startswith("heads") else 2.0
            if name == "heads.heading" and "type" not in network.plan.tasks:
                gain = 0.0  # never trained: the same probability for each class
            fan_in = module.weight[0].numel()
            with torch.no_grad():
                module.weight.normal_(0.0, (gain / fan_in) ** 0.5, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()


def fold(network: Network) -> Network:
    """The plain network that computes what `network` computes in evaluation mode.

    For `mtl` that is the paper's. Folded in double precision.
    """
    double = copy.deepcopy(network).cpu().double()
    fold_norms(double)
    for name, rows in (("distance", slice(0, 5)), ("angle", slice(5, 6))):
        std = double.target_std[rows]
        with torch.no_grad():
            double.get_parameter(f"heads.{name}.weight").mul_(std[:, None])
            bias = double.get_parameter(f"heads.{name}.bias")
            bias.mul_(std).add_(double.target_mean[rows])
    folded = Network(plan=network.plan)
    state = double.state_dict()
    folded.load_state_dict({name: state[name].float() for name in folded.state_dict()})
    return folded.eval()


def load_network(path: Path, name: str = MTL.name) -> Network:
    """The network called `name` with the weights of a `model.safetensors`."""
    network = Network(plan=find_plan(name))
    network.load_state_dict(load_file(path))
    return network.eval()


def answer_images(network: Network, images: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Images (B, 210, 280, 3) -> (B, 9): coded distances and angle, class probabilities."""
    return describe_images(network, images)[1]


def describe_images(
    network: Network, images: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The last shared features (B, 256) of images (B, 210, 280, 3), and the answers (B, 9)."""
    device = next(network.parameters()).device
    network.eval()
    with torch.inference_mode():
        x = network.describe(torch.from_numpy(images).to(device)).float()
        outputs = network.answer(x)
        outputs[:, 6:] = torch.softmax(outputs[:, 6:], 1)
    return x.cpu().numpy(), outputs.cpu().numpy()
