"""Training that goes on from a finished model: `mtlnet train --init RUN --data FOLDER`.

The model keeps its network and its camera: recorded rounds must be of the same, a user's own images
(`mtlnet.own_images`) are scaled to it. It starts as the folded network, without normalisation.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from datagen.recording import Dataset, Frames
from mtlnet.card import WEIGHTS, Camera, ModelCard, ModelError, check_files, read_card, resolve_run
from mtlnet.doubt_fit import hold_out
from mtlnet.network import Network, load_network
from mtlnet.own_images import OwnImages, open_own_images
from mtlnet.report import describe_data, mean_answer
from trackfeatures.errors import UserError

TUNED_LEAST = (0.15,) * 5 + (0.03,)
"""Least units of the heads, as varied driving has them: a few images may not vary at all."""


@dataclass(frozen=True)
class Material:
    """What a run learns from; `held_out` rounds are for its second head, `about` for its card."""

    frames: Frames | OwnImages
    held_out: Frames | None
    camera: Camera
    about: dict[str, Any]


def open_init(name: str | Path) -> tuple[Path, ModelCard]:
    """The model that training starts from; ModelError when there is none, or it is damaged."""
    run = resolve_run(name)
    card = read_card(run)
    check_files(run, card, (WEIGHTS,))
    return run, card


def own_material(folder: Path, card: ModelCard | None) -> Material:
    """A user's own images, of the camera of the model that is tuned; UserError without one."""
    if card is None:
        raise UserError(
            f"{folder} holds images of your own, which do not say what camera took them; give the "
            "model to fine-tune with --init RUN, or --init default"
        )
    images = open_own_images(folder, card.camera)
    about = {
        "path": str(folder),
        "content_hash": images.content_hash,
        "frames": len(images),
        "split": {"train": [str(folder)], "test": []},
        "held_out": [],
        "seeds": [],
        "tracks": [],
        "mean": mean_answer(images.labels),
    }
    return Material(images, None, card.camera, about)


def round_material(dataset: Dataset) -> Material:
    """The train rounds of a dataset."""
    frames, held_out = hold_out(dataset)
    camera = Camera(**dataset.camera.as_dict())  # type: ignore[arg-type]  # sizes are int
    return Material(frames, held_out, camera, describe_data(dataset, frames, held_out))


def continued(material: Material, card: ModelCard) -> Material:
    """The same, of a model that goes on from that of `card`: what that has seen, this has seen."""
    if material.camera != card.camera:
        raise ModelError(
            f"the camera of the data is {material.camera}, that of model {card.name} "
            f"{card.camera}; a model keeps the camera it was trained for"
        )
    about = {**material.about, "init": {"name": card.name, "model_hash": card.model_hash}}
    for name in ("seeds", "tracks"):
        about[name] = sorted({*about[name], *card.data.get(name, ())})
    return Material(material.frames, material.held_out, material.camera, about)


def take_weights(network: Network, run: Path) -> None:
    """Make `network` answer as the model of `run`, whatever units its own heads answer in."""
    state = load_network(run / WEIGHTS, network.plan.name).state_dict()
    mean, std = network.target_mean.cpu(), network.target_std.cpu()
    for name, rows in (("distance", slice(0, 5)), ("angle", slice(5, 6))):
        weight, bias = (f"heads.{name}.{kind}" for kind in ("weight", "bias"))
        state[weight] = state[weight] / std[rows, None]
        state[bias] = (state[bias] - mean[rows]) / std[rows]
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            parameter.copy_(state[name])
