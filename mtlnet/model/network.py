"""The multi-task network of the paper (section IV-C) and the other networks of
`mtlnet.architecture`.

Input: uint8 RGB images (B, 210, 280, 3). Output (B, 9): five coded distances and the coded angle
(linear), then scores of the classes left, straight, right (before the softmax). Recipe `fast`
trains a reparametrised form with batch normalisation after every convolution and standardised
regression targets; `fold` converts it exactly to the paper's network.
"""

import copy
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from mtlnet.architecture import (
    HEIGHT,
    MTL,
    WIDTH,
    Architecture,
    Conv,
    LocalNorm,
    Pool,
    find_architecture,
    output_size,
    same_padding,
)
from mtlnet.model.auxiliary import AuxiliaryHeads
from mtlnet.model.bins import (
    Scores,
    absent_probabilities,
    log_spreads,
    read_scores,
    split_scores,
)
from runtime.files import utf8_path

NORM_EPS = 1e-5
NORM_MOMENTUM = 0.1
RUN_BATCH = 32
"""Images per batch of `predict_images`; the features of one image take some MB."""
CODED_HEADS = (("distance", slice(0, 5)), ("angle", slice(5, 6)))
"""Heads of coded values and their columns in the outputs."""


class Network(nn.Module):
    """A network of the given architecture.

    Recipe `fast` trains it with `batch_norm`, and with the mean and standard deviation of the coded
    training targets in `target_mean` (6,) and `target_std` (6,); otherwise these are 0 and 1.
    """

    target_mean: Tensor
    target_std: Tensor

    def __init__(
        self, *, batch_norm: bool = False, dropout: float = 0.0, architecture: Architecture = MTL
    ) -> None:
        super().__init__()
        self.architecture = architecture
        self.features, size = build_features(architecture, batch_norm=batch_norm)
        self.shared = nn.Sequential()
        for number, units in enumerate(architecture.shared):
            # No batch normalisation here: batch statistics add noise to the distances.
            self.shared.add_module(f"fc{number}", block(nn.Linear(size, units), None, dropout))
            size = units
        heads = {name: nn.Linear(size, units) for name, units in architecture.heads}
        self.heads = nn.ModuleDict(heads)
        # Used only in training: `fold` omits them.
        self.auxiliary = None
        if architecture.bins and architecture.keeps_places and batch_norm:
            self.auxiliary = AuxiliaryHeads(architecture, size)
        # Mean and standard deviation of the coded targets; 0 and 1, as in the paper, until the
        # trainer sets them.
        self.register_buffer("target_mean", torch.zeros(6), persistent=batch_norm)
        self.register_buffer("target_std", torch.ones(6), persistent=batch_norm)

    def forward(self, images: Tensor) -> Tensor:
        """Compute the outputs (B, 9) float32 for images (B, 210, 280, 3), uint8 or float with
        colours in [-1, 1]: five coded distances, the coded angle (`trackfeatures.coding`) and three
        class scores before the softmax."""
        return self.forward_heads(self.forward_features(images))

    def forward_features(self, images: Tensor) -> Tensor:
        """Compute the last shared features (B, 256), the input of the heads, for images
        (B, 210, 280, 3)."""
        features: Tensor = self.shared(self.forward_grid(images).flatten(1))
        return features

    def forward_grid(self, images: Tensor) -> Tensor:
        """Compute the features of the last convolution, C channels of h x w px (B, C, h, w), for
        images (B, 210, 280, 3)."""
        # `first_row` is counted from the bottom, because images may lack the unread rows above it.
        images = images[:, images.shape[1] - HEIGHT + self.architecture.first_row :]
        x = (normalise(images) if images.dtype == torch.uint8 else images).permute(0, 3, 1, 2)
        grid: Tensor = self.features(x)
        return grid

    def forward_heads(self, x: Tensor) -> Tensor:
        """Compute five coded distances, the coded angle and three class scores before the softmax
        (B, 9) from the last shared features (B, 256)."""
        # float32 also under autocast: coded values differ little, and the heads are small.
        with torch.autocast(x.device.type, enabled=False):
            x = x.float()
            if self.architecture.bins:
                scores = self.forward_scores(x)
                return torch.cat([read_scores(scores.distance, scores.angle), scores.heading], 1)
            coded = torch.cat([self.heads["distance"](x), self.heads["angle"](x)], 1)
            return torch.cat(
                [coded * self.target_std + self.target_mean, self.heads["heading"](x)], 1
            )

    def nine_outputs(self, x: Tensor) -> Tensor:
        """Compute five coded distances, the coded angle and three class probabilities (B, 9) from
        last shared features (B, 256)."""
        outputs = self.forward_heads(x)
        return torch.cat([outputs[:, :6], torch.softmax(outputs[:, 6:], 1)], 1)

    def uncertainty_inputs(self, x: Tensor) -> Tensor:
        """Compute the inputs of the uncertainty head (B, 256), or (B, 262) for a network with heads
        over bins, from last shared features (B, 256).

        They are the last shared features and, for heads over bins, the logarithms of the standard
        deviations of the six distributions.
        """
        if not self.architecture.bins:
            return x
        scores = self.forward_scores(x)
        return torch.cat([x.float(), log_spreads(scores.distance, scores.angle)], 1)

    def absent_probabilities(self, x: Tensor) -> Tensor:
        """Compute the probability that each marking is absent (B, 5) from the last shared features
        (B, 256) of a network with heads over bins."""
        return absent_probabilities(self.forward_scores(x).distance)

    def forward_scores(self, x: Tensor) -> Scores:
        """Compute the scores of the heads, before the softmax, from the last shared features
        (B, 256) of a network with heads over bins."""
        with torch.autocast(x.device.type, enabled=False):
            each = [self.heads[name](x.float()) for name, _ in self.architecture.heads]
            return split_scores(*each)


def normalise(images: Tensor) -> Tensor:
    """Scale uint8 colours 0 to 255, an array of any shape, to float32 in [-1, 1], as the exported
    graph does."""
    return images.float() * (1 / 127.5) - 1.0


def initialise(network: Network, seed: int) -> None:
    """Initialise the weights from `seed`: He normal before a ReLU, small values in the heads."""
    generator = torch.Generator().manual_seed(seed)
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv2d | nn.Linear):
            gain = 0.01 if name.startswith(("heads", "auxiliary")) else 2.0
            if name == "heads.heading" and "heading" not in network.architecture.tasks:
                gain = 0.0  # an untrained head: equal probabilities
            fan_in = module.weight[0].numel()
            with torch.no_grad():
                module.weight.normal_(0.0, (gain / fan_in) ** 0.5, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()


def load_network(path: Path, name: str = MTL.name) -> Network:
    """Load the weights in the file `path` into the network called `name`, and return it in
    evaluation mode."""
    network = Network(architecture=find_architecture(name))
    with utf8_path(path) as plain:
        network.load_state_dict(load_file(plain))
    return network.eval()


def predict_images(network: Network, images: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Compute coded distances, coded angle and class probabilities (B, 9) for uint8 images
    (B, 210, 280, 3), in batches of 32. The network is left in evaluation mode."""
    network.eval()
    device = next(network.parameters()).device
    parts = []
    with torch.inference_mode():
        for first in range(0, max(len(images), 1), RUN_BATCH):
            batch = torch.from_numpy(images[first : first + RUN_BATCH]).to(device)
            parts.append(network.nine_outputs(network.forward_features(batch)))
    return torch.cat(parts).cpu().numpy()


# Layers.


class SamePad(nn.Module):
    """Zero padding before a layer without padding of its own. Padding and layer together give the
    result of the layer with TensorFlow's SAME padding.

    `layer`: the description of the layer; `height`, `width`: size in px of the map that is padded.
    """

    def __init__(self, height: int, width: int, layer: Conv | Pool) -> None:
        super().__init__()
        _, top, bottom = same_padding(height, layer.kernel, layer.stride)
        _, left, right = same_padding(width, layer.kernel, layer.stride)
        self.pads = (left, right, top, bottom)

    def forward(self, x: Tensor) -> Tensor:
        # Zeros do not change a maximum of values after ReLU, so pools are padded with zeros too.
        return nn.functional.pad(x, self.pads) if any(self.pads) else x


class Residual(nn.Sequential):
    """A sequence of layers whose input is added to its output."""

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = super().forward(x)  # type: ignore[no-untyped-call]  # torch leaves it untyped
        return x + y


def block(
    layer: nn.Module, norm: nn.Module | None, dropout: float = 0.0, *, skip: bool = False
) -> nn.Sequential:
    """Make a sequence of `layer`, batch normalisation if `norm` is given, ReLU, and dropout if
    `dropout` (a probability) is above 0. With `skip` the sequence adds its input to its output."""
    parts: list[tuple[str, nn.Module]] = [("layer", layer)]
    if norm is not None:
        parts.append(("norm", norm))
    parts.append(("relu", nn.ReLU()))
    if dropout:
        parts.append(("dropout", nn.Dropout(dropout)))
    sequence = Residual() if skip else nn.Sequential()
    for name, part in parts:
        sequence.add_module(name, part)
    return sequence


def build_features(architecture: Architecture, *, batch_norm: bool) -> tuple[nn.Module, int]:
    """Build the part of the network before the fully connected layers, a module that maps images
    (B, 3, H, W) to features. Returns the module and the number of features of one image."""
    if architecture.backbone:
        return build_backbone(architecture.backbone, batch_norm=batch_norm)
    features = nn.Sequential()
    channels, height, width = 3, HEIGHT - architecture.first_row, WIDTH
    for number, spec in enumerate(architecture.features):
        if isinstance(spec, LocalNorm):
            norm = nn.LocalResponseNorm(spec.size, spec.alpha, spec.beta)
            features.add_module(f"norm{number}", norm)
            continue
        if spec.same if isinstance(spec, Pool) else spec.pad is None:
            features.add_module(f"pad{number}", SamePad(height, width, spec))
        height, width = output_size(height, spec), output_size(width, spec)
        if isinstance(spec, Pool):
            pool = nn.MaxPool2d(spec.kernel, spec.stride, ceil_mode=not spec.same)
            features.add_module(f"pool{number}", pool)
            continue
        features.add_module(f"conv{number}", _convolution(channels, spec, batch_norm))
        channels = spec.filters
    return features, channels * height * width


def _convolution(channels: int, spec: Conv, batch_norm: bool) -> nn.Sequential:
    conv = nn.Conv2d(
        channels,
        spec.filters,
        spec.kernel,
        spec.stride,
        padding=spec.pad or 0,
        groups=spec.groups,
        bias=not batch_norm,
    )
    norm = nn.BatchNorm2d(spec.filters, eps=NORM_EPS) if batch_norm else None
    return block(conv, norm, skip=spec.skip)


def build_backbone(name: str, *, batch_norm: bool) -> tuple[nn.Module, int]:
    """Build the torchvision model called `name` without its classifier, randomly initialised.
    Returns the module and its number of features.

    Without `batch_norm` its batch normalisation is folded into the convolutions.
    """
    from torchvision.models import get_model

    model: nn.Module = get_model(name, weights=None)
    last = "fc" if hasattr(model, "fc") else "classifier"
    classifier = next(m for m in getattr(model, last).modules() if isinstance(m, nn.Linear))
    setattr(model, last, nn.Identity())
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            # torchvision's momentum of 0.01 suits runs of 100,000 steps. In shorter runs the
            # running means and variances would lag behind the weights.
            module.momentum = NORM_MOMENTUM
    if not batch_norm:
        fold_norms(model)
    return model, int(classifier.in_features)


# Folding batch normalisation and target standardisation.


def fold(network: Network) -> Network:
    """Return an equivalent network without batch normalisation and target standardisation, in
    evaluation mode. `network` does not change.

    For `mtl` it is the paper's network. The new weights are computed in float64.
    """
    double = copy.deepcopy(network).cpu().double()
    fold_norms(double)
    for name, rows in () if network.architecture.bins else CODED_HEADS:
        std = double.target_std[rows]
        with torch.no_grad():
            double.get_parameter(f"heads.{name}.weight").mul_(std[:, None])
            bias = double.get_parameter(f"heads.{name}.bias")
            bias.mul_(std).add_(double.target_mean[rows])
    folded = Network(architecture=network.architecture)
    state = double.state_dict()
    folded.load_state_dict({name: state[name].float() for name in folded.state_dict()})
    return folded.eval()


def fold_norms(network: nn.Module) -> None:
    """Fold each batch normalisation of `network` into the preceding convolution, and set evaluation
    mode (in place)."""
    network.eval()
    for sequence in [m for m in network.modules() if isinstance(m, nn.Sequential)]:
        for (first, conv), (second, norm) in pairwise(list(sequence.named_children())):
            if isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                setattr(sequence, first, fuse_conv_bn_eval(conv, norm))
                setattr(sequence, second, nn.Identity())
