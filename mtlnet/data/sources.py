"""Training data of a run: the train rounds of a dataset, or a user's own images."""

import hashlib
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.recording import Dataset, DatasetError, Frames, UndecodableImage
from mtlnet.data.custom_images import CustomImages, has_labels_file, open_custom_images
from mtlnet.evaluation.metrics import describe_data, mean_labels
from mtlnet.inference.model_card import ModelCard, ModelError
from mtlnet.inference.rectification import CAMERA_FILE
from mtlnet.model.architecture import HEIGHT, WIDTH, find_architecture
from mtlnet.model.pretrained import match_convolutions
from mtlnet.training.config import TrainConfig
from mtlnet.training.recipes import find_recipe
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

HELD_OUT_SHARE = 1 / 12
MIN_ROUNDS_TO_HOLD_OUT = 8
"""With fewer train rounds none is held out."""
CHUNK = 64  # images decoded at a time
MAX_NAMED = 5  # undecodable images named in a message


@dataclass(frozen=True)
class TrainingData:
    """Frames of a run, of one camera."""

    frames: Frames | CustomImages
    held_out: Frames | None
    """Rounds for fitting the uncertainty head."""
    camera: CameraParameters
    about: dict[str, Any]
    """The `data` field of the model card."""

    def spread_images(self, count: int) -> NDArray[np.uint8]:
        """At most `count` images (B, 210, 280, 3), evenly spread over the frames."""
        count = min(count, len(self.frames))
        rows = np.linspace(0, len(self.frames) - 1, count).astype(np.int64)
        return self.frames.read_batch(rows, np.empty((count, HEIGHT, WIDTH, 3), np.uint8))


def open_training_data(
    config: TrainConfig, init: ModelCard | None, *, checked: bool = False
) -> TrainingData:
    """Open `config.data`, recorded rounds or a user's own images, with the model to fine-tune.

    All images are decoded once, so that a damaged one ends the run at its start; `checked`: this
    was done before. Raises UserError for data that does not fit the network or the model.
    """
    normalised = find_recipe(config.recipe).batch_norm
    if init is not None and normalised and find_architecture(init.network).backbone:
        raise UserError(
            f"--init is a {init.network}: the batch normalisation of torchvision's networks cannot "
            "be put back; fine-tune it with --recipe tune"
        )
    if init is not None and init.network != config.network:
        if not normalised:
            raise UserError(
                f"--init is a {init.network}, not a {config.network}; leave out --network, or give "
                "--recipe continue"
            )
        match_convolutions(find_architecture(init.network), find_architecture(config.network))
    if has_labels_file(config.data):
        data = custom_training_data(config.data, init)
    else:
        dataset = open_training_dataset(config.data)
        if not (checked or config.skip_undecodable):
            require_decodable(dataset.select("train"), config.data, skippable=True)
        data = recorded_training_data(dataset, skip_undecodable=config.skip_undecodable)
    if init is not None:
        require_camera(init, data.camera)
    return data


def open_training_dataset(path: Path) -> Dataset:
    """The dataset in folder `path`; UserError when its images do not have the network's size."""
    dataset = Dataset.open(path)
    camera = dataset.camera
    if (camera.width, camera.height) != (WIDTH, HEIGHT):
        raise UserError(
            f"the images of {path} are {camera.width} x {camera.height}, the network takes "
            f"{WIDTH} x {HEIGHT}; collect with the default camera size"
        )
    if not camera.is_plain:
        raise UserError(
            f"the images of {path} are of a camera ({camera}) with distortion, roll, yaw or a "
            "matrix of its own, which a network is not trained on; collect without --camera, or "
            "with a fov_y_deg alone: pictures of any lens are warped into the model's camera"
        )
    dataset.select("train")  # raises where there are none
    return dataset


def custom_training_data(folder: Path, card: ModelCard | None) -> TrainingData:
    """A user's own images, taken by the camera of the model `card`; UserError without a model."""
    if card is None:
        raise UserError(
            f"{folder} holds images of your own, without a description of their camera; give the "
            "model to fine-tune with --init RUN, or --init default"
        )
    if (folder / CAMERA_FILE).exists():
        raise UserError(
            f"{folder / CAMERA_FILE}: training takes images of the model's own camera only; delete "
            "the file if they are, else evaluate or predict"
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
        "mean": mean_labels(images.labels),
    }
    return TrainingData(images, None, card.camera, about)


def recorded_training_data(dataset: Dataset, *, skip_undecodable: bool = False) -> TrainingData:
    """The train rounds of a dataset; `skip_undecodable`: without frames that cannot be decoded."""
    frames, held_out = hold_out_rounds(dataset)
    left_out: list[str] = []
    if skip_undecodable:
        frames, left_out = drop_undecodable(frames, dataset.path)
    if skip_undecodable and held_out is not None:
        held_out, more = drop_undecodable(held_out, dataset.path)
        left_out += more
    about = describe_data(dataset, frames, held_out)
    return TrainingData(frames, held_out, dataset.camera, {**about, "undecodable": left_out})


def hold_out_rounds(dataset: Dataset) -> tuple[Frames, Frames | None]:
    """Divide the train rounds of a dataset: those to train on, and those held out.

    The held-out rounds are for fitting the uncertainty head. They depend only on the set of rounds;
    rounds whose tracks and lights occur least among those already held out come first.
    """
    rounds = [info for info in dataset.rounds if info.split == "train"]
    conditions = {info.id: {info.track, *info.lights} for info in rounds}
    if len(conditions) < MIN_ROUNDS_TO_HOLD_OUT:
        return dataset.select("train"), None
    held_out: list[str] = []
    order = sorted(conditions, key=lambda name: hashlib.sha256(name.encode()).digest())
    for _ in range(round(len(conditions) * HELD_OUT_SHARE) or 1):
        seen = [condition for name in held_out for condition in conditions[name]]
        left = [name for name in order if name not in held_out]
        held_out.append(min(left, key=lambda name: sum(seen.count(c) for c in conditions[name])))
    kept = [name for name in conditions if name not in held_out]
    return select_rounds(dataset, kept), select_rounds(dataset, held_out)


def select_rounds(dataset: Dataset, names: list[str]) -> Frames:
    """The frames of the rounds with these ids."""
    chosen = [i for i, info in enumerate(dataset.rounds) if info.id in names]
    return Frames(
        [dataset.rounds[i] for i in chosen], [dataset.indexes[i] for i in chosen], dataset.camera
    )


def continue_from_model(data: TrainingData, card: ModelCard) -> TrainingData:
    """The data for training the model of `card` on; its training data is added to `about`."""
    about = {
        **_with_seen(data.about, card.data),
        "init": _origin(card),
        "earlier": [*card.data.get("earlier", ()), _summary(card.data)],
    }
    return replace(data, about=about)


def resume_data(
    config: TrainConfig,
    data: TrainingData,
    earlier: dict[str, Any],
    start: ModelCard | None = None,
) -> TrainingData:
    """The data of a resumed run; that of its past is added to `about` when it was another.

    `earlier`: the description of the run's data so far. `start`: the model whose weights the run
    needs again, since it has no checkpoint. Raises ModelError when that is another model than at
    first, or when `data` is other data and `config.change_data` is not set.
    """
    if start is not None and earlier.get("init") != _origin(start):
        raise ModelError(
            f"{config.out} has no checkpoint, and the model {config.init} is not the one it was "
            "started from; start a new run"
        )
    history = list(earlier.get("earlier", ()))
    if config.change_data and data.about["content_hash"] != earlier.get("content_hash"):
        history.append(_summary(earlier))
    else:
        require_same_data(config, earlier, data.about)
    if not history:
        return data
    about = {**_with_seen(data.about, earlier), "earlier": history}
    if "init" in earlier:  # the model that this name meant when the run was started
        about["init"] = earlier["init"]
    return replace(data, about=about)


def _origin(card: ModelCard) -> dict[str, Any]:
    """What a description of data says of the model that a run starts from."""
    return {"name": card.name, "model_hash": card.model_hash}


def _summary(data: dict[str, Any]) -> dict[str, Any]:
    """What a model's card says of a dataset that it was trained on before."""
    return {name: data.get(name) for name in ("path", "content_hash", "frames")}


def _with_seen(about: dict[str, Any], earlier: dict[str, Any]) -> dict[str, Any]:
    """The description `about` with the rounds and tracks of `earlier` as seen, too."""
    seen = {name: sorted({*about[name], *earlier.get(name, ())}) for name in ("seeds", "tracks")}
    return {**about, **seen}


def require_same_data(config: TrainConfig, resumed: dict[str, Any], data: dict[str, Any]) -> None:
    """Raise ModelError unless a resumed run's data is that of its start."""
    for name in ("content_hash", "split"):
        if resumed.get(name) != data.get(name):
            raise ModelError(
                f"the {name.replace('_', ' ')} of {config.data} is not the one {config.out} was "
                "started with; give that dataset with --data, add --change-data to continue on "
                "this one, or start a new run"
            )


def require_camera(card: ModelCard, camera: CameraParameters) -> None:
    """Raise ModelError when data of `camera` is not of the model's camera."""
    found, expected = camera.as_dict(), card.camera.as_dict()
    if found != expected:
        differing = ", ".join(
            f"{k} {found[k]:g} instead of {expected[k]:g}"
            for k in expected
            if found[k] != expected[k]
        )
        raise ModelError(
            f"the camera of the data is not that of model {card.name}: {differing}; collect with "
            "the model's camera, or train a model for this one"
        )


def find_undecodable(frames: Frames) -> dict[int, UndecodableImage]:
    """Decode all frames; the errors of those whose image or label is damaged, by row."""
    images = np.empty((CHUNK, frames.camera.height, frames.camera.width, 3), np.uint8)
    found: dict[int, UndecodableImage] = {}
    for first in range(0, len(frames), CHUNK):
        rows = np.arange(first, min(first + CHUNK, len(frames)))
        with suppress(UndecodableImage):
            frames.read_batch(rows, images[: len(rows)])
            for row in rows.tolist():
                frames.require_label(row)
            continue
        for row in rows.tolist():
            try:
                frames.image(row)
                frames.require_label(row)
            except UndecodableImage as error:
                found[row] = error
    return found


def require_decodable(frames: Frames, data: Path, *, skippable: bool = False) -> None:
    """Decode all frames; DatasetError that counts and names those that cannot be decoded.

    `skippable`: whether the command has the option --skip-undecodable.
    """
    found = list(find_undecodable(frames).values())
    if not found:
        return
    named = ", ".join(f"image {e.frame} of round {e.round_id}" for e in found[:MAX_NAMED])
    more = f" and {len(found) - MAX_NAMED} more" if len(found) > MAX_NAMED else ""
    skip = ", or leave these frames out with --skip-undecodable" if skippable else ""
    raise DatasetError(
        f"{len(found)} of {len(frames)} images in {data} cannot be decoded: {named}{more} "
        f"({found[0].reason}); record those rounds again{skip}"
    )


def drop_undecodable(frames: Frames, data: Path) -> tuple[Frames, list[str]]:
    """`frames` without those that cannot be decoded, and the names of the latter.

    Raises DatasetError when none is left.
    """
    found = find_undecodable(frames)
    if len(found) == len(frames):
        require_decodable(frames, data)
    names = [f"{error.round_id}/{error.frame}" for error in found.values()]
    return frames.without(found) if found else frames, names
