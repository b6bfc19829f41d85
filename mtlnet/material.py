"""What a run learns from: the train rounds of a dataset, or a user's own images."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.recording import Dataset, Frames
from mtlnet.card import Camera, ModelCard, ModelError
from mtlnet.config import TrainConfig
from mtlnet.doubt_fit import hold_out
from mtlnet.own_images import OwnImages, is_own, open_own_images
from mtlnet.plan import HEIGHT, WIDTH
from mtlnet.readable import decodable, require_decodable
from mtlnet.report import describe_data, mean_answer
from trackfeatures.errors import UserError


@dataclass(frozen=True)
class Material:
    """What a run learns from; `held_out` rounds are for its second head, `about` for its card."""

    frames: Frames | OwnImages
    held_out: Frames | None
    camera: Camera
    about: dict[str, Any]


def open_material(
    config: TrainConfig, init: ModelCard | None, *, checked: bool = False
) -> Material:
    """What `config.data` holds, recorded rounds or a user's own images; UserError: it cannot be.

    All images are decoded once, for a fault in one would end the run where it is met; `checked`:
    they were.
    """
    if init is not None and init.network != config.network:
        raise UserError(f"--init is a {init.network}, not a {config.network}; leave out --network")
    if is_own(config.data):
        material = own_material(config.data, init)
    else:
        dataset = open_training_data(config.data)
        if not (checked or config.skip_undecodable):
            require_decodable(dataset.select("train"), config.data, skippable=True)
        material = round_material(dataset, skip_undecodable=config.skip_undecodable)
    return material if init is None else continued(material, init)


def open_training_data(path: Path) -> Dataset:
    """The dataset in folder `path`; UserError when it does not fit this network."""
    dataset = Dataset.open(path)
    camera = dataset.camera
    if (camera.width, camera.height) != (WIDTH, HEIGHT):
        raise UserError(
            f"the images of {path} are {camera.width} x {camera.height}, the network takes "
            f"{WIDTH} x {HEIGHT}; collect with the default camera size"
        )
    dataset.select("train")  # raises where there are none
    return dataset


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


def round_material(dataset: Dataset, *, skip_undecodable: bool = False) -> Material:
    """The train rounds of a dataset; with `skip_undecodable` the frames that can be decoded."""
    frames, held_out = hold_out(dataset)
    left_out: list[str] = []
    if skip_undecodable:
        frames, left_out = decodable(frames, dataset.path)
    if skip_undecodable and held_out is not None:
        held_out, more = decodable(held_out, dataset.path)
        left_out += more
    camera = Camera(**dataset.camera.as_dict())  # type: ignore[arg-type]  # sizes are int
    about = describe_data(dataset, frames, held_out)
    return Material(frames, held_out, camera, {**about, "undecodable": left_out})


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


def require_same_data(config: TrainConfig, resumed: dict[str, Any], data: dict[str, Any]) -> None:
    """Raise ModelError unless the run goes on with what it began with."""
    for name in ("content_hash", "split", "init"):
        if resumed.get(name) != data.get(name):
            raise ModelError(
                f"the {name.replace('_', ' ')} of {config.data} is not the one {config.out} was "
                "started with; give that dataset with --data, or start a new run"
            )
