"""Writers of the files of `mtlnet predict --out`: tables (.csv, .jsonl), a film (.mp4), a recording
for Foxglove (.mcap) or pictures.

Each row and frame is written immediately, so that an interrupted command keeps its results so far.
Names that are not UTF-8 are written in tables as described in `runtime.files`.
"""

import csv
import json
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from stat import S_ISDIR
from typing import Any, Protocol, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording.images import encode
from mtlnet.data.labels_file import LABELS
from mtlnet.inference.overlay import draw_overlay
from mtlnet.inference.prediction import Prediction
from mtlnet.sources.read import SourceImage
from runtime.files import atomic_write
from runtime.film import FILM_SUFFIX, Mp4Writer
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

MCAP_SUFFIX = ".mcap"
TABLE_SUFFIXES = (".csv", ".jsonl")
FILE_SUFFIXES = (*TABLE_SUFFIXES, FILM_SUFFIX, MCAP_SUFFIX)
TEXT_HEIGHT = 64
"""Height of the text with the features below a picture, px."""
TEXT_COLOUR = (235, 235, 235)
PICTURE_NAMES = "[0-9][0-9][0-9][0-9]*-*.png"
"""Pattern that matches all file names of `PictureWriter`."""
MAX_STEM_BYTES = 200
"""Maximum length, bytes, of an image's name within the file name of its picture; a file name has at
most 255."""


class Writer(Protocol):
    """Interface of a writer of images and predictions, one by one. Leaving the context closes the
    file."""

    def write(self, item: SourceImage, prediction: Prediction) -> None: ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


def check_output(path: Path) -> None:
    """Raise UserError if `open_writer` cannot write to `path`: for an unknown suffix, a parent
    folder that does not exist, a folder instead of a file, or a file instead of a folder."""
    kind = _kind(path)
    if kind not in (*FILE_SUFFIXES, ""):
        kinds = ", ".join(FILE_SUFFIXES)
        raise UserError(f"--out {path}: give a file ending in {kinds}, or a folder for pictures")
    if not path.parent.is_dir():
        raise UserError(f"--out {path}: there is no folder {path.parent}; make it first")
    if kind and path.is_dir():
        raise UserError(f"--out {path} is a folder; give the name of a file in it")
    if not kind and path.exists() and not path.is_dir():
        raise UserError(f"--out {path} is a file; give a folder for pictures")


def _kind(path: Path) -> str:
    """Return the suffix of an output in lower case; empty for a folder of pictures, which may have
    a dot in its name if it exists."""
    suffix = path.suffix.lower()
    return "" if suffix not in FILE_SUFFIXES and path.is_dir() else suffix


def open_writer(path: Path, camera: CameraParameters, fps: float) -> Writer:
    """Open the writer for the suffix of `path`, which empties a file that exists; a path without a
    suffix is a folder of pictures. Call `check_outputs` first.

    `camera`: the model's camera, in whose view pictures are drawn. `fps`: frames per second of a
    film or recording. Raises OSError if the file cannot be opened.
    """
    kind = _kind(path)
    if kind in TABLE_SUFFIXES:
        return TableWriter(path)
    if kind == MCAP_SUFFIX:
        from mtlnet.predict.mcap_writer import McapWriter

        return McapWriter(path, camera, fps)
    return FilmWriter(path, camera, fps) if kind == FILM_SUFFIX else PictureWriter(path, camera)


def require_inputs_kept(outputs: Sequence[Path], inputs: Iterable[Path]) -> None:
    """Raise UserError if one of `outputs` is one of the files `inputs`, also by another name or
    link, is the labels.csv beside one of them, or is a folder in which one of `inputs` has a name
    like those of `PictureWriter`."""
    read = list(inputs)
    places = {_place(path) for path in read} - {None}
    labels = {_place(folder / LABELS) for folder in {path.parent for path in read}} - {None}
    for output in outputs:
        if _place(output) in labels:
            raise UserError(f"--out {output} holds the labels of the pictures; give another file")
        if _place(output) in places:
            raise UserError(f"--out {output} is a file to read; give another one")
        for path in output.glob(PICTURE_NAMES):
            if _place(path) in places:
                raise UserError(
                    f"--out {output}: {path} is a file to read, which a drawn picture could "
                    "replace; give another folder"
                )


def _place(path: Path) -> tuple[int, int] | None:
    """Device and inode of the file at `path`; None for a folder, or where there is nothing."""
    try:
        found = path.stat()
    except (OSError, ValueError):
        return None
    return None if S_ISDIR(found.st_mode) else (found.st_dev, found.st_ino)


def check_outputs(outputs: Sequence[Path]) -> None:
    """Raise UserError if `open_writer` cannot write to one of `outputs` (`check_output`), or if two
    of them are the same file or folder, also by other names."""
    places = [path.resolve() for path in outputs]
    for number, path in enumerate(outputs):
        check_output(path)
        if places[number] in places[:number]:
            raise UserError(f"--out {path} is given twice; give each file once")


def table_row(item: SourceImage, prediction: Prediction) -> dict[str, Any]:
    """Return the features of one image as a flat dict from column to value, in m and rad; a value
    that is absent, unknown or not predicted is None."""
    std = prediction.std or {}
    row: dict[str, Any] = {"image": item.name, "time_s": item.time_s}
    for marking in tf.MARKINGS:
        row[f"{marking}_m"] = prediction.distances_m[marking]
    row["to_lane_centre_m"] = prediction.to_lane_centre_m
    row["angle_rad"] = prediction.angle_rad
    row |= {f"p_{name}": probability for name, probability in prediction.heading.items()}
    for name in (*tf.MARKINGS, "to_lane_centre", "angle"):
        row[f"std_{name}"] = std.get(name)
    row["out_of_distribution"] = prediction.out_of_distribution
    absent = prediction.absent or {}
    return row | {f"p_absent_{marking}": absent.get(marking) for marking in tf.MARKINGS}


class TableWriter:
    """Writes one row of features per image as CSV with a header, or as one JSON object per line."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._as_csv = path.suffix.lower() == ".csv"
        self._file = path.open("w", encoding="utf-8", errors="backslashreplace", newline="")
        self._csv: csv.DictWriter[str] | None = None

    def write(self, item: SourceImage, prediction: Prediction) -> None:
        row = table_row(item, prediction)
        try:
            self._write_row(row)
            self._file.flush()
        except OSError as error:
            error.filename = str(self._path)  # missing after a failed write
            raise

    def _write_row(self, row: dict[str, Any]) -> None:
        if not self._as_csv:
            self._file.write(json.dumps(row) + "\n")
            return
        if self._csv is None:
            self._csv = csv.DictWriter(self._file, list(row))
            self._csv.writeheader()
        self._csv.writerow(row)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):  # `write` has reported it; on a full disk closing fails again
            self._file.close()


class FilmWriter:
    """Writes frames with drawn markings as an MP4 film (MPEG-4), which is playable even if the
    command is interrupted."""

    def __init__(self, path: Path, camera: CameraParameters, fps: float) -> None:
        self._camera, self._film = camera, Mp4Writer(path, fps)

    def write(self, item: SourceImage, prediction: Prediction) -> None:
        self._film.write(draw_prediction(item, prediction, self._camera))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._film.__exit__(*error)


class PictureWriter:
    """Writes frames with drawn markings as PNG files, named by a number from `0000` and the name of
    the image."""

    def __init__(self, folder: Path, camera: CameraParameters) -> None:
        self._folder, self._camera, self._count = folder, camera, 0
        folder.mkdir(exist_ok=True)

    def write(self, item: SourceImage, prediction: Prediction) -> None:
        picture = draw_prediction(item, prediction, self._camera)
        stem = os.fsdecode(os.fsencode(Path(item.source).stem)[:MAX_STEM_BYTES])
        frame = [] if item.frame is None else [str(item.frame)]
        name = "-".join((f"{self._count:04d}", stem, *frame))
        # Not written by OpenCV, which needs UTF-8 names and does not report why it fails.
        atomic_write(self._folder / f"{name}.png", encode(picture, "png"))
        self._count += 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def view_of(item: SourceImage, model: CameraParameters) -> CameraParameters:
    """Return the camera of the image that the network sees: the model's camera `model`, moved to
    the position on the car of the camera that took the image."""
    return model if item.lens is None else item.lens.view


def draw_prediction(
    item: SourceImage, prediction: Prediction, model: CameraParameters
) -> NDArray[np.uint8]:
    """Draw the image with its markings (prediction orange, a round's labels green), a view from
    above beside it, and the features as text below it. Returns uint8 RGB (H, W, 3).

    Without labels the markings are drawn straight, because the curvature is not predicted.
    """
    assert item.image is not None
    truth = item.truth
    camera = view_of(item, model)
    picture = draw_overlay(
        item.image,
        camera,
        truth.curvature if truth else 0.0,
        (truth.distances_m, truth.angle_rad) if truth else ({}, 0.0),
        (prediction.distances_m, prediction.angle_rad),
    )
    below = np.full((TEXT_HEIGHT, picture.shape[1], 3), 24, np.uint8)
    for line, text in enumerate(feature_lines(prediction)):
        place = (10, 26 + 24 * line)
        cv2.putText(below, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, TEXT_COLOUR, 1, cv2.LINE_AA)
    return np.vstack([picture, below])


def feature_lines(prediction: Prediction) -> tuple[str, str]:
    """Return two lines of text. The first has the distances in m, the second the offset from the
    lane centre in m, the angle in rad and the class."""
    distances = "  ".join(
        f"{name} {_metres(value)}" for name, value in prediction.distances_m.items()
    )
    heading = prediction.road_class
    unfamiliar = "  out of distribution" if prediction.out_of_distribution else ""
    return (
        f"{distances}  (m)",
        f"to lane centre {_metres(prediction.to_lane_centre_m)} m  "
        f"angle {prediction.angle_rad:+.4f} rad  "
        f"{heading} {100 * prediction.heading[heading]:.0f} %{unfamiliar}",
    )


def _metres(value: float | None) -> str:
    return "--" if value is None else f"{value:+.2f}"
