"""Training that goes on from a finished model: `mtlnet train --init RUN --data FOLDER`.

The model keeps its network and its camera: recorded rounds must be of the same, a user's own images
(`mtlnet.data.custom_images`) are scaled to it. It starts as the folded network, without
normalisation.
"""

from pathlib import Path

import torch

from mtlnet.inference.model_card import WEIGHTS, ModelCard, check_files, read_card, resolve_run
from mtlnet.model.network import Network, load_network

TUNED_LEAST = (0.15,) * 5 + (0.03,)
"""Least units of the heads, as varied driving has them: a few images may not vary at all."""


def open_init(name: str | Path) -> tuple[Path, ModelCard]:
    """The model that training starts from; ModelError when there is none, or it is damaged."""
    run = resolve_run(name)
    card = read_card(run)
    check_files(run, card, (WEIGHTS,))
    return run, card


def take_weights(network: Network, run: Path) -> None:
    """Make `network` answer as the model of `run`, whatever units its own heads answer in."""
    state = load_network(run / WEIGHTS, network.architecture.name).state_dict()
    mean, std = network.target_mean.cpu(), network.target_std.cpu()
    for name, rows in (("distance", slice(0, 5)), ("angle", slice(5, 6))):
        weight, bias = (f"heads.{name}.{kind}" for kind in ("weight", "bias"))
        state[weight] = state[weight] / std[rows, None]
        state[bias] = (state[bias] - mean[rows]) / std[rows]
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            parameter.copy_(state[name])
