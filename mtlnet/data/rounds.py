"""Opens recorded rounds for training, holds some of them out, and finds undecodable frames."""

import hashlib
import logging
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

import numpy as np

from datagen.recording import Dataset, DatasetError, Frames, UndecodableImage
from datagen.recording.splits import split_path
from mtlnet.architecture import HEIGHT, WIDTH
from mtlnet.inference.model_card import ModelCard, ModelError
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

HELD_OUT_SHARE = 1 / 12
MIN_ROUNDS_TO_HOLD_OUT = 8
"""Minimum number of train rounds; with fewer no round is held out."""
CHUNK = 64  # images decoded at a time
MAX_NAMED = 5  # undecodable images named in a message

log = logging.getLogger(__name__)


def open_training_dataset(path: Path) -> Dataset:
    """Open the dataset in folder `path`. Logs a warning about rounds on no side of the split, which
    are not used. Raises UserError when the images do not fit the network, or when there is no train
    round."""
    dataset = Dataset.open(path)
    camera = dataset.camera
    if (camera.width, camera.height) != (WIDTH, HEIGHT):
        raise UserError(
            f"the images of {path} are {camera.width} x {camera.height}, the network takes "
            f"{WIDTH} x {HEIGHT}; collect with the default camera size"
        )
    if camera.y != 0.0:
        raise UserError(
            f"the images of {path} are of a camera {camera.y:g} m beside the middle of the car, "
            "which a network is not trained on, because training mirrors images; collect with y = "
            "0: pictures of any camera are warped into the model's camera"
        )
    if not camera.is_plain:
        raise UserError(
            f"the images of {path} are of a camera ({camera}) with distortion, roll, yaw or a "
            "matrix of its own, which a network is not trained on; collect without --camera, or "
            "with a fov_y_deg alone: pictures of any lens are warped into the model's camera"
        )
    dataset.select("train")  # raises where there are none
    unused = sum(not info.split for info in dataset.rounds)
    if unused:
        log.warning(
            "%d of the %d rounds of %s are not used, because its split (%s) does not name them",
            unused,
            len(dataset.rounds),
            path,
            split_path(path),
        )
    return dataset


def hold_out_rounds(dataset: Dataset) -> tuple[Frames, Frames | None]:
    """Divide the train rounds of a dataset into rounds to train on and held-out rounds, on which
    the uncertainty head is fitted. With fewer than eight train rounds, all are trained on, and the
    second result is None.

    The division depends only on the set of rounds. The next held-out round is always the round
    whose track and lights are rarest among the rounds that are already held out.
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
    """Return the frames of the rounds whose ids are in `names`."""
    chosen = [i for i, info in enumerate(dataset.rounds) if info.id in names]
    return Frames(
        [dataset.rounds[i] for i in chosen], [dataset.indexes[i] for i in chosen], dataset.camera
    )


def require_camera(card: ModelCard, camera: CameraParameters) -> None:
    """Raise ModelError when `camera`, the camera of the data, differs from the model's camera."""
    if differing := differing_values(camera, card.camera):
        raise ModelError(
            f"the camera of the data is not that of model {card.name}: {differing}; collect with "
            "the model's camera, or train a model for this one"
        )


def differing_values(found: CameraParameters, expected: CameraParameters) -> str:
    """Return the fields in which two cameras differ, for a message; empty if they are equal."""
    values, others = asdict(found), asdict(expected)
    return ", ".join(
        f"{name} {_text(values[name])} instead of {_text(others[name])}"
        for name in others
        if values[name] != others[name]
    )


def _text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def find_undecodable(frames: Frames) -> dict[int, UndecodableImage]:
    """Decode every frame, and return the errors of the frames with a damaged image or label, by
    row."""
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
    """Decode all frames; raise DatasetError with the number of undecodable frames and the names of
    the first five.

    `data`: the dataset's folder, for the message. `skippable`: the command has the option
    --skip-undecodable, which the message then mentions.
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
    """Decode all frames; returns `frames` without the undecodable frames, and the names
    "ROUND/FRAME" of the undecodable frames.

    Raises DatasetError when no frame is left.
    """
    found = find_undecodable(frames)
    if len(found) == len(frames):
        require_decodable(frames, data)
    names = [f"{error.round_id}/{error.frame}" for error in found.values()]
    return frames.without(found) if found else frames, names
