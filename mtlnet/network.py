"""The multi-task network of the paper (section IV-C), with TensorFlow's SAME padding.

Input: uint8 RGB images (B, 210, 280, 3). Output (B, 9): five coded distances and the coded angle
(linear), and the scores of the classes left, straight, right (before softmax). Recipe `fast`
trains a rescaled form of it, with batch normalisation after every convolution, and
heads that answer in standard deviations; `fold` turns that into the paper's network, exactly.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file
from torch import Tensor, nn

HEIGHT, WIDTH = 210, 280
NORM_EPS = 1e-5


@dataclass(frozen=True)
class Conv:
    """Conv(n, k, s) of the paper: n filters of k x k with stride s, ReLU."""

    filters: int
    kernel: int
    stride: int


@dataclass(frozen=True)
class Pool:
    """MaxPool(k, s) of the paper."""

    kernel: int = 3
    stride: int = 2


FEATURES: tuple[Conv | Pool, ...] = (
    Conv(96, 11, 4),
    Pool(),
    Conv(256, 5, 2),
    Pool(),
    Conv(384, 3, 2),
    Conv(384, 3, 2),
    Conv(256, 3, 2),
    Pool(),
)
SHARED = (4096, 1024, 256)
HEADS = (("distance", 5), ("angle", 1), ("heading", 3))


def same_padding(size: int, kernel: int, stride: int) -> tuple[int, int, int]:
    """TensorFlow's SAME: output size, zeros before, zeros after; the odd one goes after."""
    out = -(-size // stride)
    total = max((out - 1) * stride + kernel - size, 0)
    return out, total // 2, total - total // 2


class SamePad(nn.Module):
    """Zeros around an image, as SAME padding of the next layer asks."""

    def __init__(self, height: int, width: int, layer: Conv | Pool) -> None:
        super().__init__()
        self.out_height, top, bottom = same_padding(height, layer.kernel, layer.stride)
        self.out_width, left, right = same_padding(width, layer.kernel, layer.stride)
        self.pads = (left, right, top, bottom)

    def forward(self, x: Tensor) -> Tensor:
        # A maximum of values after ReLU is not changed by zeros, so pools are padded with them too.
        return nn.functional.pad(x, self.pads) if any(self.pads) else x


def block(layer: nn.Module, norm: nn.Module | None, dropout: float = 0.0) -> nn.Sequential:
    """layer - [batch normalisation] - ReLU - [dropout]."""
    parts: list[tuple[str, nn.Module]] = [("layer", layer)]
    if norm is not None:
        parts.append(("norm", norm))
    parts.append(("relu", nn.ReLU()))
    if dropout:
        parts.append(("dropout", nn.Dropout(dropout)))
    sequence = nn.Sequential()
    for name, part in parts:
        sequence.add_module(name, part)
    return sequence


class Network(nn.Module):
    """The network; with `batch_norm` and other `target_*`, the form that recipe `fast` trains."""

    target_mean: Tensor
    target_std: Tensor

    def __init__(self, *, batch_norm: bool = False, dropout: float = 0.0) -> None:
        super().__init__()
        self.features = nn.Sequential()
        channels, height, width = 3, HEIGHT, WIDTH
        for number, spec in enumerate(FEATURES):
            pad = SamePad(height, width, spec)
            height, width = pad.out_height, pad.out_width
            self.features.add_module(f"pad{number}", pad)
            if isinstance(spec, Pool):
                self.features.add_module(f"pool{number}", nn.MaxPool2d(spec.kernel, spec.stride))
                continue
            conv = nn.Conv2d(channels, spec.filters, spec.kernel, spec.stride, bias=not batch_norm)
            norm = nn.BatchNorm2d(spec.filters, eps=NORM_EPS) if batch_norm else None
            channels = spec.filters
            self.features.add_module(f"conv{number}", block(conv, norm))
        self.shared = nn.Sequential()
        size = channels * height * width
        for number, units in enumerate(SHARED):
            # Not normalised: what neighbours in a batch add to an image is noise to a distance.
            self.shared.add_module(f"fc{number}", block(nn.Linear(size, units), None, dropout))
            size = units
        self.heads = nn.ModuleDict({name: nn.Linear(size, units) for name, units in HEADS})
        # Heads answer in these units; (0, 1), the paper's, unless recipe `fast` sets others.
        self.register_buffer("target_mean", torch.zeros(6), persistent=batch_norm)
        self.register_buffer("target_std", torch.ones(6), persistent=batch_norm)

    def forward(self, images: Tensor) -> Tensor:
        """Images (B, 210, 280, 3), uint8 or already normalised float -> (B, 9) float32."""
        x = (normalise(images) if images.dtype == torch.uint8 else images).permute(0, 3, 1, 2)
        x = self.shared(self.features(x).flatten(1))
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
            fan_in = module.weight[0].numel()
            with torch.no_grad():
                module.weight.normal_(0.0, (gain / fan_in) ** 0.5, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()


def fold(network: Network) -> Network:
    """The paper's network that computes what `network` computes in evaluation mode."""
    folded = Network()
    state = network.state_dict()
    result = folded.state_dict()
    for name in result:
        prefix, _, kind = name.rpartition(".")
        weight = state[f"{prefix}.weight"].double()
        block_name = prefix.removesuffix(".layer")
        if f"{block_name}.norm.weight" in state:
            norm = {
                key: state[f"{block_name}.norm.{key}"].double()
                for key in ("weight", "bias", "running_mean", "running_var")
            }
            gain = norm["weight"] / torch.sqrt(norm["running_var"] + NORM_EPS)
            bias = norm["bias"] - norm["running_mean"] * gain
        else:
            gain, bias = _head_scale(network, prefix, state)
        scaled = weight * gain.reshape(-1, *[1] * (weight.ndim - 1))
        result[name] = (scaled if kind == "weight" else bias).float().cpu().contiguous()
    folded.load_state_dict(result)
    return folded.eval()


def _head_scale(network: Network, prefix: str, state: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    bias = state[f"{prefix}.bias"].double()
    rows = {"heads.distance": slice(0, 5), "heads.angle": slice(5, 6)}.get(prefix)
    if rows is None:
        return torch.ones_like(bias), bias
    std, mean = network.target_std[rows].double(), network.target_mean[rows].double()
    return std, bias * std + mean


def load_network(path: Path) -> Network:
    """The paper's network with the weights of a `model.safetensors`."""
    network = Network()
    network.load_state_dict(load_file(path))
    return network.eval()


def answer_images(network: Network, images: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Images (B, 210, 280, 3) -> (B, 9): coded distances and angle, class probabilities."""
    device = next(network.parameters()).device
    network.eval()
    with torch.inference_mode():
        outputs = network(torch.from_numpy(images).to(device))
        outputs[:, 6:] = torch.softmax(outputs[:, 6:], 1)
    answers: NDArray[np.float32] = outputs.cpu().numpy()
    return answers
