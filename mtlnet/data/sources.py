"""What a run learns from: the train rounds of a dataset, or a user's own images."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from datagen.recording import Dataset, DatasetError, Frames, UndecodableImage
from mtlnet.data.custom_images import CustomImages, has_labels_file, open_custom_images
from mtlnet.evaluation.metrics import describe_data, mean_answer
from mtlnet.inference.model_card import ModelCard, ModelError
from mtlnet.model.architecture import HEIGHT, WIDTH
from mtlnet.training.config import TrainConfig
from mtlnet.uncertainty_fit.head import hold_out
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError


@dataclass(frozen=True)
class TrainingData:
    """What a run learns from; `held_out` rounds are for its second head, `about` for its card."""

    frames: Frames | CustomImages
    held_out: Frames | None
    camera: CameraParameters
    about: dict[str, Any]


def open_training_data(
    config: TrainConfig, init: ModelCard | None, *, checked: bool = False
) -> TrainingData:
    """What `config.data` holds, recorded rounds or a user's own images; UserError: it cannot be.

    All images are decoded once, for a fault in one would end the run where it is met; `checked`:
    they were.
    """
    if init is not None and init.network != config.network:
        raise UserError(f"--init is a {init.network}, not a {config.network}; leave out --network")
    if has_labels_file(config.data):
        material = custom_training_data(config.data, init)
    else:
        dataset = open_training_dataset(config.data)
        if not (checked or config.skip_undecodable):
            require_decodable(dataset.select("train"), config.data, skippable=True)
        material = recorded_training_data(dataset, skip_undecodable=config.skip_undecodable)
    return material if init is None else continue_from_model(material, init)


def open_training_dataset(path: Path) -> Dataset:
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


def custom_training_data(folder: Path, card: ModelCard | None) -> TrainingData:
    """A user's own images, of the camera of the model that is tuned; UserError without one."""
    if card is None:
        raise UserError(
            f"{folder} holds images of your own, which do not say what camera took them; give the "
            "model to fine-tune with --init RUN, or --init default"
        )
    images = open_custom_images(folder, card.camera)
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
    return TrainingData(images, None, card.camera, about)


def recorded_training_data(dataset: Dataset, *, skip_undecodable: bool = False) -> TrainingData:
    """The train rounds of a dataset; with `skip_undecodable` the frames that can be decoded."""
    frames, held_out = hold_out(dataset)
    left_out: list[str] = []
    if skip_undecodable:
        frames, left_out = decodable(frames, dataset.path)
    if skip_undecodable and held_out is not None:
        held_out, more = decodable(held_out, dataset.path)
        left_out += more
    about = describe_data(dataset, frames, held_out)
    return TrainingData(frames, held_out, dataset.camera, {**about, "undecodable": left_out})


def continue_from_model(material: TrainingData, card: ModelCard) -> TrainingData:
    """The same, of a model that goes on from that of `card`: what that has seen, this has seen."""
    if material.camera != card.camera:
        raise ModelError(
            f"the camera of the data is {material.camera}, that of model {card.name} "
            f"{card.camera}; a model keeps the camera it was trained for"
        )
    about = {**material.about, "init": {"name": card.name, "model_hash": card.model_hash}}
    for name in ("seeds", "tracks"):
        about[name] = sorted({*about[name], *card.data.get(name, ())})
    return TrainingData(material.frames, material.held_out, material.camera, about)


def require_same_data(config: TrainConfig, resumed: dict[str, Any], data: dict[str, Any]) -> None:
    """Raise ModelError unless the run goes on with what it began with."""
    for name in ("content_hash", "split", "init"):
        if resumed.get(name) != data.get(name):
            raise ModelError(
                f"the {name.replace('_', ' ')} of {config.data} is not the one {config.out} was "
                "started with; give that dataset with --data, or start a new run"
            )


# Images that cannot be decoded, found before a run that would meet them after an hour.


CHUNK = 64  # images at a time
NAMED = 5


def undecodable(frames: Frames) -> dict[int, UndecodableImage]:
    """Which frames have an image that cannot be decoded, and why; all are decoded."""
    images = np.empty((CHUNK, frames.camera.height, frames.camera.width, 3), np.uint8)
    found: dict[int, UndecodableImage] = {}
    for first in range(0, len(frames), CHUNK):
        rows = np.arange(first, min(first + CHUNK, len(frames)))
        try:
            frames.read_batch(rows, images[: len(rows)])
        except UndecodableImage:
            found.update(_each(frames, rows.tolist()))
    return found


def _each(frames: Frames, rows: list[int]) -> dict[int, UndecodableImage]:
    found = {}
    for row in rows:
        try:
            frames.image(row)
        except UndecodableImage as error:
            found[row] = error
    return found


def require_decodable(frames: Frames, data: Path, *, skippable: bool = False) -> None:
    """Raise DatasetError that counts and names the images that cannot be decoded.

    `skippable`: the command has --skip-undecodable.
    """
    found = list(undecodable(frames).values())
    if not found:
        return
    named = ", ".join(f"image {e.frame} of round {e.round_id}" for e in found[:NAMED])
    more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    skip = ", or leave these frames out with --skip-undecodable" if skippable else ""
    raise DatasetError(
        f"{len(found)} of {len(frames)} images in {data} cannot be decoded: {named}{more} "
        f"({found[0].reason}); record those rounds again{skip}"
    )


def decodable(frames: Frames, data: Path) -> tuple[Frames, list[str]]:
    """`frames` without those that cannot be decoded, and the names of these.

    Raises DatasetError when none are left.
    """
    found = undecodable(frames)
    if len(found) == len(frames):
        require_decodable(frames, data)
    names = [f"{error.round_id}/{error.frame}" for error in found.values()]
    return frames.without(found) if found else frames, names


def require_all_decodable(dataset: Dataset, sides: tuple[str, ...]) -> None:
    """Raise DatasetError unless every image of these sides of a split can be decoded."""
    for side in sides:
        require_decodable(dataset.select(side), dataset.path)
