"""A user's own images with a `labels.csv`: `mtlnet train --init RUN`, `mtlnet evaluate`.

Columns (named by a header, in any order): `file`, a path within the folder; `ml`, `mr`, `l`, `m`,
`r`, in m, left negative, empty where there is no such marking; `angle`, rad, positive when the car
points to the right of the track; `heading`: left, straight or right. The images must be of the
model's camera, in any size of the same aspect ratio; for an evaluation also of the camera that a
`camera.yaml` in the folder describes.
"""

import csv
import hashlib
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.image_decoding.decode import crop_and_resize, read_whole_image
from mtlnet.inference.rectification import Rectification
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

LABELS = "labels.csv"
COLUMNS = ("file", *tf.MARKINGS, "angle", "heading")
MARKING_LIMITS_M = {
    "ml": (-5.5, -0.5),
    "mr": (0.5, 5.5),
    "l": (-7.0, -1.5),
    "m": (-2.0, 2.75),
    "r": (1.5, 7.0),
}
"""Range of the network's coding; labels beyond it would be clipped."""
ANGLE_LIMIT_RAD = 0.5
ASPECT_TOLERANCE = 0.01
MAX_READERS = 8  # threads; each may hold a photo of 0.8 GB


@dataclass(frozen=True)
class CustomLabels:
    """`distances` (N, 5) m, NaN where absent; `angle` (N,) rad; `heading` (N,) classes."""

    distances: NDArray[np.float32]
    angle: NDArray[np.float32]
    heading: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.angle)


@dataclass(frozen=True)
class CustomImages:
    """Labelled images in memory, (N, H, W, 3) uint8 of the camera's size (0.18 MB each)."""

    path: Path
    labels: CustomLabels
    images: NDArray[np.uint8]
    content_hash: str

    def __len__(self) -> int:
        return len(self.images)

    def every(self, count: int) -> "CustomImages":
        """Every `count`-th image."""
        labels = self.labels
        kept = CustomLabels(
            labels.distances[::count], labels.angle[::count], labels.heading[::count]
        )
        return replace(self, labels=kept, images=self.images[::count])

    def read_batch(
        self, indices: NDArray[np.int64], out: NDArray[np.uint8] | None = None
    ) -> NDArray[np.uint8]:
        """The images of `indices`, (B, H, W, 3), in `out` where one is given."""
        return np.take(self.images, indices, axis=0, out=out)


def has_labels_file(folder: Path) -> bool:
    """Whether a folder holds a user's own images rather than recorded rounds."""
    return (folder / LABELS).is_file()


def open_custom_images(
    folder: Path, camera: CameraParameters, rectification: Rectification | None = None
) -> CustomImages:
    """Read labels and images of a folder; images are scaled to the camera's size, or rectified.

    Raises UserError that names the faulty line of `labels.csv`, also for an image that is missing,
    damaged, or of another aspect ratio than the camera's.
    """
    files, labels = read_labels(folder / LABELS)
    images = np.empty((len(files), camera.height, camera.width, 3), np.uint8)

    def decode(number: int) -> bytes:
        path = folder / files[number][1]
        try:
            if rectification is None:
                images[number] = _read_uncropped(path, camera)
            else:
                images[number] = rectification.image(read_whole_image(path))
        except UserError as error:
            error.args = (f"{folder / LABELS}, line {files[number][0]}: {error}",)
            raise
        return hashlib.sha256(path.read_bytes()).digest()

    digest = hashlib.sha256((folder / LABELS).read_bytes())
    with ThreadPoolExecutor(MAX_READERS) as pool:
        for part in pool.map(decode, range(len(files))):
            digest.update(part)
    return CustomImages(folder, labels, images, digest.hexdigest())


def _read_uncropped(path: Path, camera: CameraParameters) -> NDArray[np.uint8]:
    """An image of the camera's aspect ratio, at its size.

    Unlike images for prediction it is not cropped: its labels belong to the whole image.
    """
    image = read_whole_image(path)
    height, width = image.shape[:2]
    if abs(width * camera.height / (height * camera.width) - 1) > ASPECT_TOLERANCE:
        raise UserError(
            f"{path} is {width} x {height} px, the camera of the model gives "
            f"{camera.width} x {camera.height}: give images of that aspect ratio (within 1 "
            "percent), of any size"
        )
    return crop_and_resize(image, camera)


def read_labels(path: Path) -> tuple[list[tuple[int, str]], CustomLabels]:
    """(line, file) of each row of a `labels.csv`, and the labels.

    File names may have bytes that are not UTF-8, as the file system's. Raises UserError that names
    the faulty line.
    """
    files: list[tuple[int, str]] = []
    rows: list[tuple[list[float], float, int]] = []
    with path.open(newline="", encoding="utf-8-sig", errors="surrogateescape") as file:
        reader = csv.DictReader(file, strict=True)
        try:
            names = [name.strip() for name in reader.fieldnames or ()]
            reader.fieldnames = names
            if sorted(names) != sorted(COLUMNS):
                raise UserError(
                    f"{path} has the columns {', '.join(names) or 'none'}; its first line must "
                    f"name {', '.join(COLUMNS)}, with commas between them, in UTF-8"
                )
            for row in reader:
                try:
                    name, *values = _parse(row)
                except ValueError as error:
                    raise UserError(f"{path}, line {reader.line_num}: {error}") from None
                files.append((reader.line_num, name))
                rows.append(values)  # type: ignore[arg-type]  # as `_parse` gives them
        except csv.Error as error:
            raise UserError(f"{path}, after line {reader.line_num}: {error}") from error
    if not files:
        raise UserError(f"{path} names no images")
    seen: dict[str, int] = {}
    for line, name in files:
        if name in seen:
            raise UserError(f"{path}, line {line}: {name} stands in line {seen[name]} already")
        seen[name] = line
    labels = CustomLabels(
        np.array([row[0] for row in rows], np.float32),
        np.array([row[1] for row in rows], np.float32),
        np.array([row[2] for row in rows], np.int64),
    )
    return files, labels


def _parse(row: dict[str, str | None]) -> tuple[str, list[float], float, int]:
    """File, distances in m (NaN absent), angle in rad and class of a row.

    Raises ValueError that describes the fault.
    """
    if None in row or None in row.values():
        raise ValueError(f"it has not {len(COLUMNS)} values")
    cells = {name: (text or "").strip() for name, text in row.items()}
    name = cells["file"]
    if not name or Path(name).is_absolute() or ".." in Path(name).parts:
        raise ValueError(f"the file {name!r} is no path within the folder")
    found = {marking: _distance(marking, cells[marking]) for marking in tf.MARKINGS}
    if math.isnan(found["ml"]) != math.isnan(found["mr"]):
        raise ValueError("ml and mr are the two sides of one lane: give both or none")
    if math.isnan(found["m"]) and not (math.isnan(found["l"]) and math.isnan(found["r"])):
        raise ValueError("l and r stand beside m: without m they must be empty")
    angle = _number("angle", cells["angle"])
    if not abs(angle) <= ANGLE_LIMIT_RAD:
        raise ValueError(
            f"angle is {angle:g}; it must be within {ANGLE_LIMIT_RAD} rad (radians, not degrees)"
        )
    headings = {kind.name.lower(): int(kind) for kind in tf.Heading}
    if cells["heading"] not in headings:
        raise ValueError(f"heading is {cells['heading']!r}; give {', '.join(headings)}")
    return name, [found[m] for m in tf.MARKINGS], angle, headings[cells["heading"]]


def _distance(marking: str, text: str) -> float:
    if not text:
        return math.nan
    value = _number(marking, text)
    low, high = MARKING_LIMITS_M[marking]
    if not low <= value <= high:
        raise ValueError(
            f"{marking} is {value:g} m; it must be from {low:g} to {high:g} (left negative), or "
            "empty where there is none"
        )
    return value


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{name} is {text!r}, not a number") from None
