"""Opens the training data of a run: the train rounds of a dataset, or a user's own pictures."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.recording import Dataset, Frames
from mtlnet.architecture import HEIGHT, WIDTH, find_architecture
from mtlnet.data.custom_images import CustomImages, has_labels_file, open_custom_images
from mtlnet.data.description import describe_data, mean_labels
from mtlnet.data.labels_file import LABELS
from mtlnet.data.rounds import (
    differing_values,
    drop_undecodable,
    hold_out_rounds,
    open_training_dataset,
    require_camera,
    require_decodable,
)
from mtlnet.inference.model_card import ModelCard, ModelError
from mtlnet.inference.trained_rounds import Seeds, names_entry
from mtlnet.model.pretrained import match_convolutions
from mtlnet.training.config import TrainConfig
from mtlnet.training.recipes import find_recipe
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

SAME_DATA = ("content_hash", "split")
"""Entries of a description of data that are equal if a run has the same data as before."""


@dataclass(frozen=True)
class TrainingData:
    """The frames on which a run trains, all of one camera."""

    frames: Frames | CustomImages
    held_out: Frames | None
    """Frames of the rounds on which the uncertainty head is fitted; None if there are too few
    rounds."""
    camera: CameraParameters
    about: dict[str, Any]
    """Description of the data: the `data` field of the model card."""

    def spread_images(self, count: int) -> NDArray[np.uint8]:
        """Read at most `count` RGB images (B, 210, 280, 3) uint8, evenly spaced over the frames."""
        count = min(count, len(self.frames))
        rows = np.linspace(0, len(self.frames) - 1, count).astype(np.int64)
        return self.frames.read_batch(rows, np.empty((count, HEIGHT, WIDTH, 3), np.uint8))


def open_training_data(
    config: TrainConfig,
    init: ModelCard | None,
    kept: CameraParameters | None = None,
    *,
    checked: bool = False,
) -> TrainingData:
    """Open the folder `config.data` of recorded rounds or of a user's own pictures.

    `init`: card of the model to start from. `kept`: the camera to which a user's own pictures are
    rectified if `init` is None, because the run has started before. All images are decoded once, so
    that a damaged image ends the run at its start; `checked`: the images have been decoded before.
    Raises UserError for data or a network that does not fit the model.
    """
    normalised = find_recipe(config.recipe).batch_norm
    if init is not None and normalised and find_architecture(init.network).backbone:
        raise UserError(
            f"--init is a {init.network}: the batch normalisation of torchvision's networks cannot "
            "be restored; fine-tune it with --recipe tune"
        )
    if init is not None and init.network != config.network:
        if not normalised:
            raise UserError(
                f"--init is a {init.network}, not a {config.network}; leave out --network, or give "
                "--recipe continue"
            )
        if config.init_share:
            raise UserError(
                f"--init is a {init.network}, not a {config.network}: their weights have no mean; "
                "leave out --network or --init-share"
            )
        match_convolutions(find_architecture(init.network), find_architecture(config.network))
    if config.hold_out_drives and not has_labels_file(config.data):
        raise UserError(
            f"--hold-out-drives is for pictures with a {LABELS}; {config.data} holds recorded "
            "rounds, whose split defines what is held out"
        )
    if has_labels_file(config.data):
        camera = kept if init is None else init.camera
        data = custom_training_data(config.data, camera, config.hold_out_drives)
    else:
        dataset = open_training_dataset(config.data)
        if not (checked or config.skip_undecodable):
            require_decodable(dataset.select("train"), config.data, skippable=True)
        data = recorded_training_data(dataset, skip_undecodable=config.skip_undecodable)
    if init is not None:
        require_camera(init, data.camera)
    return data


def custom_training_data(
    folder: Path, camera: CameraParameters | None, drives: str = ""
) -> TrainingData:
    """Open a user's own pictures in `folder`, rectified to `camera`, the camera of the model.

    `drives`: names of drives to leave out, separated by commas. Raises UserError if `camera` is
    None.
    """
    if camera is None:
        raise UserError(
            f"{folder} holds images of your own, without a description of their camera; give the "
            "model to fine-tune with --init RUN, or --init default"
        )
    opened, held_out = hold_out_drives(open_custom_images(folder, camera), drives)
    images = opened.for_training
    about = {
        "path": str(folder),
        "content_hash": images.content_hash,
        "camera": camera.as_dict(),
        "frames": len(images),
        "split": {"train": names_entry([str(folder)]), "test": names_entry([])},
        "held_out": names_entry([]),
        "seeds": Seeds.of([]).entry(),
        "tracks": [],
        "mean": mean_labels(opened.labels),  # evaluations are in metres at the pictures' cameras
        "held_out_drives": held_out,
        "pictures": sorted({*images.hashes}),
    }
    return TrainingData(images, None, camera, about)


def hold_out_drives(images: CustomImages, drives: str) -> tuple[CustomImages, list[str]]:
    """Return the images without the drives named in `drives` (separated by commas), and the names
    of these drives.

    The drives left out are not used at all: neither for the weights nor for the standard
    deviations. Raises UserError for a drive without pictures, and when no drive is left.
    """
    known = sorted({picture.drive for picture in images.pictures})
    names = _drive_names(drives, known)
    for name in names:
        if name not in known:
            raise UserError(
                f"--hold-out-drives has {name!r}; the drives in {images.path / LABELS} are "
                f"{', '.join(repr(drive) for drive in known)}"
            )
    kept = [i for i, picture in enumerate(images.pictures) if picture.drive not in names]
    if not kept:
        raise UserError("--hold-out-drives names all drives; leave one to train on")
    return images.take(kept), names


def _drive_names(text: str, known: list[str]) -> list[str]:
    """Split `text` at its commas into names. A name in `known` is not split at its own commas; of
    several possible names the longest is taken."""
    names, parts = [], text.split(",")
    while parts:
        starts = [",".join(parts[:count]).strip() for count in range(len(parts), 0, -1)]
        name = next((start for start in starts if start in known), starts[-1])
        names.append(name)
        parts = parts[len(parts) - starts.index(name) :]
    return [name for name in names if name]


def recorded_training_data(dataset: Dataset, *, skip_undecodable: bool = False) -> TrainingData:
    """Open the train rounds of a dataset, some of them held out for the fit of the uncertainty
    head. With `skip_undecodable`, frames that cannot be decoded are left out."""
    frames, held_out = hold_out_rounds(dataset)
    left_out: list[str] = []
    if skip_undecodable:
        frames, left_out = drop_undecodable(frames, dataset.path)
    if skip_undecodable and held_out is not None:
        held_out, more = drop_undecodable(held_out, dataset.path)
        left_out += more
    about = describe_data(dataset, frames, held_out)
    return TrainingData(frames, held_out, dataset.camera, {**about, "undecodable": left_out})


def continue_from_model(data: TrainingData, card: ModelCard) -> TrainingData:
    """Return `data` for training the model of `card` further. In the result the description `about`
    also has the model's name and hash, and the datasets, tracks and seeds on which the model was
    trained."""
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
    """Return the data of a resumed run. If the run was trained on another dataset before, the
    description `about` of the result also has an entry for that dataset.

    `earlier`: the description of the run's data so far. `start`: the model whose weights the run
    needs again, because it has no checkpoint or an `init_share`. Raises ModelError when `start` is
    another model than at the first start, when `data` has another camera than the run, or when
    `data` is another dataset or has another split and `config.change_data` is not set.
    """
    if start is not None and earlier.get("init") != _origin(start):
        reason = "was started with --init-share" if config.init_share else "has no checkpoint"
        raise ModelError(
            f"{config.out} {reason}, and the model {config.init} is not the one it was started "
            "from; start a new run"
        )
    _require_run_camera(config, earlier, data.camera)
    history = list(earlier.get("earlier", ()))
    if config.change_data and any(data.about[name] != earlier.get(name) for name in SAME_DATA):
        history.append(_summary(earlier))
    else:
        require_same_data(config, earlier, data.about)
    if not history:
        return data
    about = {**_with_seen(data.about, earlier), "earlier": history}
    if "init" in earlier:  # a model of this name can have changed since the run was started
        about["init"] = earlier["init"]
    return replace(data, about=about)


def _require_run_camera(
    config: TrainConfig, earlier: dict[str, Any], camera: CameraParameters
) -> None:
    """Raise ModelError when `camera`, the camera of the data, differs from the camera of the
    resumed run, as stored in the description `earlier`."""
    if "camera" not in earlier:  # written by an earlier version
        return
    if differing := differing_values(camera, CameraParameters(**earlier["camera"])):
        raise ModelError(
            f"the camera of {config.data} is not the one {config.out} was trained with: "
            f"{differing}; collect with the run's camera, or start a new run"
        )


def _origin(card: ModelCard) -> dict[str, Any]:
    """The entry `init` of a description of data: name and hash of the model to start from."""
    return {"name": card.name, "model_hash": card.model_hash}


def _summary(data: dict[str, Any]) -> dict[str, Any]:
    """An entry of the list `earlier` in a description of data: one dataset used before."""
    return {name: data.get(name) for name in ("path", "content_hash", "frames")}


def _with_seen(about: dict[str, Any], earlier: dict[str, Any]) -> dict[str, Any]:
    """The description `about` with the tracks, pictures and round seeds of `earlier` added."""
    names = [name for name in ("tracks", "pictures") if name in about or name in earlier]
    seen: dict[str, Any] = {
        name: sorted({*about.get(name, ()), *earlier.get(name, ())}) for name in names
    }
    seeds = Seeds.read(about["seeds"]) | Seeds.read(earlier.get("seeds", ()))
    return {**about, **seen, "seeds": seeds.entry()}


def require_same_data(config: TrainConfig, resumed: dict[str, Any], data: dict[str, Any]) -> None:
    """Raise ModelError unless `data`, the description of a resumed run's data, has the same content
    hash and split as `resumed`, the description stored when the run was started."""
    for name in SAME_DATA:
        if resumed.get(name) != data.get(name):
            raise ModelError(
                f"the {name.replace('_', ' ')} of {config.data} is not the one {config.out} was "
                "started with; give that dataset with --data, add --change-data to continue on "
                "this one, or start a new run"
            )
