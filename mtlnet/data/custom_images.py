"""Reads a user's own labelled pictures (a folder with `labels.csv`) for `mtlnet train --init RUN`
and `mtlnet evaluate`.

The camera file named in a picture's row describes the picture's camera. If the row names no file,
`camera.yaml` in the folder describes it; without that file it is the model's camera. Pictures of
another camera than the model's are rectified to the model's camera
(`mtlnet.inference.rectification`).
"""

import hashlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.data.labels_file import LABELS, CustomLabels, LabelledPicture, read_labels
from mtlnet.data.picture_copies import PLAIN, copied_camera, copied_label, copied_picture
from mtlnet.inference.image_decoding.decode import crop_and_resize, read_whole_image
from mtlnet.inference.image_decoding.errors import Fault, ImageError
from mtlnet.inference.rectification import CAMERA_FILE, Rectification, read_camera
from runtime.files import file_hash
from trackfeatures.camera import CameraParameters
from trackfeatures.coding import UNKNOWN_M
from trackfeatures.errors import UserError

ASPECT_TOLERANCE = 0.01
MAX_READERS = 8  # number of threads; each may hold a photo of 0.8 GB


@dataclass(frozen=True)
class CustomImages:
    """N labelled pictures in memory, uint8 (N, H, W, 3) at the size of the model's camera (0.18 MB
    each). A mirrored or turned copy is one of the N pictures, with its own label and camera."""

    path: Path
    labels: CustomLabels
    """Labels as in the file: distances are measured at the camera that took the picture."""
    images: NDArray[np.uint8]
    content_hash: str
    pictures: tuple[LabelledPicture, ...]
    lenses: tuple[Rectification | None, ...]
    """Rectification of each picture; None where the model's camera took it."""
    copies: tuple[str, ...]
    """Kind of copy of each picture, from `mtlnet.data.picture_copies.COPIES`."""
    hashes: tuple[str, ...]
    """SHA-256 of each picture's file."""
    camera: CameraParameters
    """The model's camera."""
    refused: tuple[tuple[LabelledPicture, str, str], ...] = ()
    """Picture, kind of copy and reason, for each copy that shows too little of the model's view."""

    def __len__(self) -> int:
        return len(self.images)

    def take(self, rows: Any) -> "CustomImages":
        """Return the pictures selected by `rows`: indices, a mask (N,) or a slice."""
        chosen = np.arange(len(self))[rows].tolist()
        return replace(
            self,
            labels=self.labels.take(chosen),
            images=self.images[rows],
            pictures=tuple(self.pictures[i] for i in chosen),
            lenses=tuple(self.lenses[i] for i in chosen),
            copies=tuple(self.copies[i] for i in chosen),
            hashes=tuple(self.hashes[i] for i in chosen),
        )

    def read_batch(
        self, indices: NDArray[np.int64], out: NDArray[np.uint8] | None = None
    ) -> NDArray[np.uint8]:
        """Return the images (B, H, W, 3) with the row numbers `indices` (B,), written to `out` if
        given."""
        return np.take(self.images, indices, axis=0, out=out)

    def outputs(self, outputs: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a model's outputs (N, K) for the N pictures, with distances converted from metres
        at the model's camera to metres at the pictures' own cameras.

        `mtlnet.inference.prediction.split_outputs` explains the K columns.
        """
        found = outputs.copy()
        for lens in {lens for lens in self.lenses if lens is not None}:
            rows = [i for i, each in enumerate(self.lenses) if each == lens]
            found[rows] = lens.outputs(outputs[rows])
        return found

    @cached_property
    def for_training(self) -> "CustomImages":
        """The same pictures, with labels converted to metres at the model's camera.

        Raises UserError with the line of `labels.csv` if a converted distance is outside the range
        of the network's coding.
        """
        distances = self.labels.distances.copy()
        for row, lens in enumerate(self.lenses):
            if lens is not None:
                rows = slice(row, row + 1)
                distances[rows] = lens.labels(distances[rows], self.labels.angle[rows])
                _require_range(self.path / LABELS, self.pictures[row], lens, distances[row])
        labels = replace(self.labels, distances=distances)
        return replace(self, labels=labels)


def has_labels_file(folder: Path) -> bool:
    """Return whether a folder has a `labels.csv`: it then holds a user's own pictures instead of
    recorded rounds."""
    return (folder / LABELS).is_file()


def files_to_read(folder: Path) -> list[Path]:
    """Return the files of a folder of labelled pictures: `labels.csv`, the pictures and the camera
    files. Raises UserError for a faulty `labels.csv`."""
    pictures, _ = read_labels(folder / LABELS)
    names = [LABELS, *_camera_files(folder, pictures), *(picture.file for picture in pictures)]
    return [folder / name for name in dict.fromkeys(names)]


def open_custom_images(
    folder: Path,
    camera: CameraParameters,
    copies: Sequence[str] = (PLAIN,),
    *,
    every: int = 1,
    skip_refused: bool = False,
) -> CustomImages:
    """Read the labels and pictures of a folder, and make the `copies` of each picture (kinds of
    `mtlnet.data.picture_copies.COPIES`) as seen by `camera`.

    `camera`: the model's camera. `every`: read every n-th picture only, from the first on, with all
    its copies. Raises UserError with the line of `labels.csv` for a faulty row, for a picture that
    is missing, damaged or not of its camera's aspect ratio, and for a picture that shows too little
    of the model's view. With `skip_refused`, pictures that show too little of the model's view are
    listed in `refused` instead; the error is raised only if no other picture is left.
    """
    path = folder / LABELS
    pictures, labels = read_labels(path)
    pictures, labels = pictures[::every], labels.take(slice(None, None, every))
    cameras = picture_cameras(folder, pictures, camera)
    digest = hashlib.sha256(path.read_bytes())
    for name in sorted({*_camera_files(folder, pictures)}):
        digest.update((folder / name).read_bytes())
    kept: list[tuple[int, str, str]] = []
    images: list[NDArray[np.uint8]] = []
    refused: list[tuple[LabelledPicture, str, str]] = []
    for row, (found, made) in enumerate(
        _read_pictures(folder, pictures, cameras, camera, copies, skip_refused)
    ):
        digest.update(bytes.fromhex(found))
        for copy, image in zip(copies, made, strict=True):
            if isinstance(image, ImageError):
                refused.append((pictures[row], copy, str(image)))
            else:
                kept.append((row, copy, found))
                images.append(image)
    if not kept:
        raise UserError(f"{path}: no picture shows enough of the model's view; {refused[0][2]}")
    chosen = [copied_label(labels, row, cameras[row] or camera, copy) for row, copy, _ in kept]
    return CustomImages(
        folder,
        CustomLabels(*(np.concatenate(column) for column in zip(*chosen, strict=True))),
        np.stack(images),
        digest.hexdigest(),
        tuple(pictures[row] for row, _, _ in kept),
        tuple(_lens(cameras[row], camera, copy) for row, copy, _ in kept),
        tuple(copy for _, copy, _ in kept),
        tuple(found for _, _, found in kept),
        camera,
        tuple(refused),
    )


def _read_pictures(
    folder: Path,
    pictures: Sequence[LabelledPicture],
    cameras: Sequence[CameraParameters | None],
    camera: CameraParameters,
    copies: Sequence[str],
    skip_refused: bool,
) -> Iterator[tuple[str, list[NDArray[np.uint8] | ImageError]]]:
    """Yield, for each picture, the SHA-256 of its file and its copies as seen by `camera`. An
    ImageError stands for a copy that shows too little of the view of `camera`."""

    def read(row: int) -> tuple[str, list[NDArray[np.uint8] | ImageError]]:
        file = folder / pictures[row].file
        try:
            whole = read_whole_image(file)
            made = [_prepared(file, whole, cameras[row], camera, copy) for copy in copies]
            faults = [each for each in made if isinstance(each, ImageError)]
            if faults and not skip_refused:
                raise faults[0]
        except UserError as error:
            error.args = (f"{folder / LABELS}, line {pictures[row].line}: {error}",)
            raise
        return file_hash(file), made

    with ThreadPoolExecutor(MAX_READERS) as pool:
        yield from pool.map(read, range(len(pictures)))


def picture_cameras(
    folder: Path, pictures: Sequence[LabelledPicture], model: CameraParameters
) -> list[CameraParameters | None]:
    """Return the camera of each picture; None stands for the model's camera, `model`. Raises
    UserError for a faulty camera file."""
    known: dict[str, CameraParameters] = {}
    found: list[CameraParameters | None] = []
    for picture in pictures:
        name = picture.camera or (CAMERA_FILE if (folder / CAMERA_FILE).exists() else "")
        if name and name not in known:
            try:
                known[name] = read_camera(folder / name, model)
            except UserError as error:
                where = f"{folder / LABELS}, line {picture.line}: " if picture.camera else ""
                raise UserError(f"{where}{error}") from error
        camera = known[name] if name else None
        if picture.pitch_deg is not None:
            camera = replace(camera or model, pitch_deg=picture.pitch_deg)
        found.append(camera)
    return found


def _require_range(
    path: Path, picture: LabelledPicture, lens: Rectification, distances: NDArray[np.float32]
) -> None:
    for marking, value in zip(tf.MARKINGS, distances.tolist(), strict=True):
        low, high = tf.RANGES[marking].lo, tf.RANGES[marking].hi
        if not np.isnan(value) and value != UNKNOWN_M and not low <= value <= high:
            raise UserError(
                f"{path}, line {picture.line}: from the height of the model's camera "
                f"({lens.target.height_above_road_m:g} m, the picture's "
                f"{lens.source.height_above_road_m:g} m) {marking} is {value:.2f} m, which the "
                f"network cannot express ({low:g} to {high:g}); leave the picture out"
            )


def _camera_files(folder: Path, pictures: Sequence[LabelledPicture]) -> list[str]:
    named = [picture.camera for picture in pictures if picture.camera]
    return [*named, CAMERA_FILE] if (folder / CAMERA_FILE).exists() else named


def _lens(
    source: CameraParameters | None, target: CameraParameters, copy: str
) -> Rectification | None:
    if source is None:
        return None
    return Rectification(copied_camera(source, copy), target)


def _prepared(
    path: Path,
    image: NDArray[np.uint8],
    source: CameraParameters | None,
    target: CameraParameters,
    copy: str,
) -> NDArray[np.uint8] | ImageError:
    """Return the copy, of kind `copy`, of the picture `image` in the file `path`, as seen by the
    model's camera `target`.

    `source`: the picture's camera; None: the model's camera. Returns an ImageError for a copy that
    shows too little of the view of `target`; raises all other errors.
    """
    if copy != PLAIN:
        image = copied_picture(image, source or target, copy)
    if source is None:
        return _uncropped(path, image, target)
    lens = Rectification(copied_camera(source, copy), target)
    try:
        return lens.image(image)
    except ImageError as error:
        if error.fault is not Fault.FIELD_OF_VIEW:
            raise
        return error


def _uncropped(path: Path, image: NDArray[np.uint8], camera: CameraParameters) -> NDArray[np.uint8]:
    """Scale an image, which must have the camera's aspect ratio, to the camera's size.

    It is not cropped, unlike images for prediction, because its labels belong to the whole image.
    """
    height, width = image.shape[:2]
    if abs(width * camera.height / (height * camera.width) - 1) > ASPECT_TOLERANCE:
        raise UserError(
            f"{path} is {width} x {height} px, the camera of the model gives "
            f"{camera.width} x {camera.height}: give images of that aspect ratio (within 1 "
            f"percent), of any size, or describe their camera in {CAMERA_FILE}"
        )
    return crop_and_resize(image, camera)
