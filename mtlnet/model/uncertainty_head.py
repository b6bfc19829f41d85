"""The uncertainty head computes a standard deviation for each feature, and an out-of-distribution
score.

Standard deviations: two layers predict the logarithm of the standard deviation of the error of each
feature (Nix and Weigend 1994). Their standardised inputs are the network's last shared features
(256,), for heads over bins the logarithms of the distributions' standard deviations (6,), and the
light features (10,) of the image (`mtlnet.model.textures.light_features`). Without the light
features the standard deviations are too large in dusk and fog and too small in snow and heavy
shadow. The network's nine outputs do not depend on this head.

The out-of-distribution (OOD) score is the larger of two values. Each is scaled so that an image is
out of distribution if the value is above 1.

- The squared Mahalanobis distance of the image's texture features from those of the training frames
  (Lee et al. 2018). The last shared features are unsuitable, because a network trained on roads
  maps other images near their mean. In a measurement with a model trained for 230 steps, at 1 %
  false alarms, the last shared features detected 1 % of noise and text images, the texture features
  detected all of these images.
- The square of the camera's pitch offset, predicted by two layers from the texture features of the
  image centre: a camera that looks up or down sees the same textures slightly higher or lower.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load, save
from torch import Tensor, nn

from mtlnet.model.textures import light_features

LIGHT_LIMIT = 3.0
"""Light features are clipped to this number of standard deviations of the training set, because the
head cannot extrapolate beyond them, especially for a model of one scene."""


class TwoLayers(nn.Module):
    """Two linear layers with a ReLU between them, (N, F) -> (N, D)."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(inputs, hidden), nn.Linear(hidden, outputs)

    def forward(self, z: Tensor) -> Tensor:
        y: Tensor = self.second(self.first(z).relu())
        return y


class UncertaintyHead(nn.Module):
    """The head with the weights of `state`, a state dict of this module.

    In shapes F is the number of inputs of the layers that predict standard deviations, D = 7 the
    number of features with a standard deviation, C the number of texture values of all cells, and M
    the number of texture values of the image centre. Raises KeyError for a missing tensor,
    RuntimeError for shapes that do not fit each other.
    """

    centre: Tensor  # (F,)
    scale: Tensor  # (F,) z = (x - centre) * scale
    low: Tensor  # (D,) lower limit of the logarithm, against extreme values
    high: Tensor  # (D,) upper limit of the logarithm
    texture_mean: Tensor  # (C,)
    texture_directions: Tensor  # (C, C) distance = |directions (cells - mean)|^2; > 1: OOD
    pitch_centre: Tensor  # (M,)
    pitch_scale: Tensor  # (M,)

    def __init__(self, state: Mapping[str, Tensor]) -> None:
        super().__init__()
        for name in BUFFERS:
            self.register_buffer(name, state[name].clone())
        sizes = {
            name: (
                *reversed(state[f"{name}.first.weight"].shape),
                len(state[f"{name}.second.bias"]),
            )
            for name in ("std", "pitch")
        }
        self.std, self.pitch = TwoLayers(*sizes["std"]), TwoLayers(*sizes["pitch"])
        self.load_state_dict(state)
        self.requires_grad_(False).eval()

    def forward(self, x: Tensor, textures: Tensor) -> Tensor:
        """Compute the standard deviations, in m and for the angle in rad, and the OOD score:
        (B, D + 1), the score last.

        `x` (B, X): result of `Network.uncertainty_inputs`; a head fitted on fewer inputs reads only
        the first columns. `textures` (B, C + M): result of
        `mtlnet.model.textures.texture_features`.
        """
        count = min(int(x.shape[1]), len(self.centre))
        z = x[:, :count]
        if len(self.centre) > count:
            z = torch.cat([z, light_features(textures)], 1)
        log_std = self.std(standardise(z, self.centre, self.scale, count))
        log_std = torch.minimum(torch.maximum(log_std, self.low), self.high)
        cells = textures[:, : len(self.texture_mean)]
        projected = nn.functional.linear(cells - self.texture_mean, self.texture_directions)
        distance = (projected * projected).sum(1, keepdim=True)
        pitch = self.pitch_offset(textures[:, len(self.texture_mean) :])
        return torch.cat([log_std.exp(), torch.maximum(distance, pitch * pitch)], 1)

    def pitch_offset(self, centre: Tensor) -> Tensor:
        """Predict the pitch of the camera relative to the training camera, (B, 1), positive
        downwards, in multiples of the limit above which an image is out of distribution.

        `centre` (B, M): the texture features of the image centre.
        """
        offset: Tensor = self.pitch((centre - self.pitch_centre) * self.pitch_scale)
        return offset

    def to_bytes(self) -> bytes:
        """Return the content of the head's file, in the format of safetensors."""
        state = self.state_dict()
        return save({stored: state[name].contiguous() for name, stored in TENSOR_NAMES.items()})


BUFFERS = (
    "centre", "scale", "low", "high", "texture_mean", "texture_directions", "pitch_centre",
    "pitch_scale",
)  # fmt: skip
TENSOR_NAMES = {
    "centre": "centre",
    "scale": "scale",
    "std.first.weight": "hidden_weight",
    "std.first.bias": "hidden_bias",
    "std.second.weight": "weight",
    "std.second.bias": "bias",
    "low": "low",
    "high": "high",
    "texture_mean": "usual",
    "texture_directions": "directions",
    "pitch_centre": "aim_centre",
    "pitch_scale": "aim_scale",
    "pitch.first.weight": "aim_hidden_weight",
    "pitch.first.bias": "aim_hidden_bias",
    "pitch.second.weight": "aim_weight",
    "pitch.second.bias": "aim_bias",
}
"""Names of the head's tensors in its file."""


def load_uncertainty_head(path: Path) -> UncertaintyHead:
    """Load the uncertainty head in the file `path`. Raises OSError, SafetensorError, KeyError or
    RuntimeError when the file is damaged."""
    tensors = load(path.read_bytes())
    return UncertaintyHead({name: tensors[stored] for name, stored in TENSOR_NAMES.items()})


def standardise(x: Tensor, centre: Tensor, scale: Tensor, count: int) -> Tensor:
    """Standardise the inputs `x` (N, F) of the layers that predict the standard deviations: the
    result (N, F) is (x - centre) * scale, with `centre` and `scale` (F,).

    The first `count` columns of `x` come from the network; the remaining columns are light
    features, whose results are clipped to -3 to 3.
    """
    z = (x - centre) * scale
    return torch.cat([z[:, :count], z[:, count:].clamp(-LIGHT_LIMIT, LIGHT_LIMIT)], 1)


@dataclass(frozen=True)
class FittedUncertainty:
    """An uncertainty head and the description of its fit, for the model card."""

    head: UncertaintyHead
    about: dict[str, Any]
