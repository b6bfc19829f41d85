"""Initialises a network from a finished model, whose batch normalisation was folded away.

A network without batch normalisation gets the model's weights. A network with batch normalisation
also gets statistics measured on images, and gains and biases that cancel the normalisation by these
statistics, so that the network's outputs equal the model's. The network may have more residual
convolutions than the model; the additional ones start near the identity
(as in Chen et al. 2016, Net2Net).
"""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mtlnet.architecture import HEIGHT, Architecture, Conv
from mtlnet.model.network import CODED_HEADS, Network, load_network, normalise
from trackfeatures.errors import UserError

NEW_SCALE = 0.02
"""Initial gain of the batch normalisation of a new residual convolution. With 0 its ReLU would pass
no gradient."""


def load_pretrained(
    network: Network, weights: Path, images: NDArray[np.uint8] | None = None, name: str = ""
) -> None:
    """Set the weights of `network` so that it computes the outputs of a finished model. The
    network's `target_mean` and `target_std`, with which a head of coded values converts its output
    to a coded value, do not change.

    `weights`: the model's file. `images` uint8 (B, 210, 280, 3): images on which the statistics of
    the batch normalisation are measured; None for a network without batch normalisation. `name`:
    the model's architecture; empty: the network's architecture. Raises UserError when the network
    does not contain all convolutions of the model.
    """
    source = load_network(weights, name or network.architecture.name)
    state = source.state_dict()
    mean, std = network.target_mean.cpu(), network.target_std.cpu()
    for head, rows in () if network.architecture.bins else CODED_HEADS:
        weight, bias = (f"heads.{head}.{kind}" for kind in ("weight", "bias"))
        state[weight] = state[weight] / std[rows, None]
        state[bias] = (state[bias] - mean[rows]) / std[rows]
    renamed = match_convolutions(source.architecture, network.architecture)
    for old, new in renamed.items():
        for kind in ("weight", "bias"):
            state[f"new.{new}.layer.{kind}"] = state.pop(f"features.{old}.layer.{kind}")
    state = {key.replace("new.", "features.", 1): tensor for key, tensor in state.items()}
    with torch.no_grad():
        for key, parameter in network.named_parameters():
            if key in state:
                parameter.copy_(state[key])
        if any(isinstance(m, nn.BatchNorm2d) for m in network.features.modules()):
            assert images is not None
            biases = {new: state[f"features.{new}.layer.bias"] for new in renamed.values()}
            restore_batch_norm(network, biases, images)


def average_with(network: Network, weights: Path, share: float) -> None:
    """Replace each weight w of `network` by (1 - share) w + share v, where v is the weight of a
    finished model and `share` is between 0 and 1.

    `network` and the model, whose file is `weights`, have the same architecture, and their batch
    normalisation is folded. After a training at a low learning rate, the mean of both models
    usually has lower errors than either of them (Wortsman et al. 2022, "Robust Fine-Tuning of
    Zero-Shot Models").
    """
    model = load_network(weights, network.architecture.name).state_dict()
    with torch.no_grad():
        for key, parameter in network.named_parameters():
            parameter.lerp_(model[key], share)


def match_convolutions(old: Architecture, new: Architecture) -> dict[str, str]:
    """Return a dict that maps the submodule name of each convolution of `old` to the name of the
    convolution of `new` that gets its weights.

    `new` may have more residual convolutions. Raises UserError for any other difference.
    """
    left = list(enumerate(old.features))
    names: dict[str, str] = {}
    for number, layer in enumerate(new.features):
        if left and layer == left[0][1]:
            if isinstance(layer, Conv):
                names[f"conv{left[0][0]}"] = f"conv{number}"
            left.pop(0)
        elif not (isinstance(layer, Conv) and layer.skip):
            left = [(number, layer)]
            break
    heads = (old.shared, old.heads, old.first_row, old.backbone)
    if left or heads != (new.shared, new.heads, new.first_row, new.backbone):
        raise UserError(
            f"--init is a {old.name}, from which a {new.name} cannot start: it may only have more "
            "residual convolutions; leave out --network"
        )
    return names


def restore_batch_norm(
    network: Network, biases: dict[str, Tensor], images: NDArray[np.uint8]
) -> None:
    """Set statistics, gains and biases of all batch normalisations, so that a network with the
    filters of a folded model computes the model's outputs (in place).

    `biases`: the biases of the model's convolutions, by submodule name; convolutions without an
    entry are new, and get the gain 0.02 and the bias 0. `images` uint8 (B, 210, 280, 3): images on
    which the statistics are measured. The filters are rescaled to the size of newly initialised
    filters, which suits the optimizer's steps; the gains cancel the scale.
    """
    network.eval()
    device = network.target_mean.device
    x = normalise(torch.from_numpy(images[:, -HEIGHT + network.architecture.first_row :]))
    x = x.permute(0, 3, 1, 2).to(device)
    for name, module in network.features.named_children():
        norm = dict(module.named_children()).get("norm")
        if isinstance(norm, nn.BatchNorm2d):
            layer = module.get_submodule("layer")
            assert isinstance(layer, nn.Conv2d)
            assert norm.running_mean is not None
            assert norm.running_var is not None
            filters = layer.weight.flatten(1)
            rms = filters.square().mean(1).sqrt().clamp_min(1e-12)
            factor = (2 / filters.shape[1]) ** 0.5 / rms
            layer.weight.mul_(factor[:, None, None, None])
            y = layer(x)
            mean, variance = y.mean((0, 2, 3)), y.var((0, 2, 3), correction=0)
            norm.running_mean.copy_(mean)
            norm.running_var.copy_(variance)
            if name in biases:
                norm.weight.copy_(torch.sqrt(variance + norm.eps) / factor)
                norm.bias.copy_(biases[name].to(device) + mean / factor)
            else:
                norm.weight.fill_(NEW_SCALE)
                norm.bias.zero_()
        x = module(x)
