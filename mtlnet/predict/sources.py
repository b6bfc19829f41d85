"""Where `mtlnet predict` takes images from: files, folders, glob patterns, films and rounds."""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.image_decoding.decode import (
    crop_and_resize,
    read_image,
    read_whole_image,
)
from mtlnet.inference.image_decoding.errors import ImageError
from mtlnet.inference.rectification import Rectification
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

IMAGES = (".jpg", ".jpeg", ".png")
FILMS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v")
ROUND = ".mcap"
DEFAULT_FPS = 20.0
READ_AHEAD = 16
"""Decoded images that wait for the network at most."""

Image = NDArray[np.uint8]
Lens = Rectification | float | None
"""Of images and films: their camera, or its vertical field of view in degrees; None: the model's.
"""


@dataclass(frozen=True)
class Truth:
    """What is known of a recorded frame: distances in m by marking, the angle in rad, and the
    curvature of the road in 1/m, left positive."""

    distances_m: dict[str, float | None]
    angle_rad: float
    curvature: float


@dataclass(frozen=True)
class SourceImage:
    """One image in the model's size, or why it cannot be used."""

    name: str
    """The file; for a film or a round with the number of the frame, from 0: `film.mp4#12`."""
    image: Image | None
    """uint8 RGB (210, 280, 3)."""
    error: str = ""
    truth: Truth | None = None


@dataclass(frozen=True)
class Source:
    """One file to take images from."""

    path: Path
    count: int
    """Number of images; of a film what its header declares. 0: it cannot be opened."""
    fps: float = DEFAULT_FPS


def find_sources(inputs: list[str]) -> list[Source]:
    """The files that arguments name: a file, all images of a folder, or those a pattern matches.

    Raises UserError for an argument that names nothing, or a kind of file that is not read.
    """
    sources: list[Source] = []
    for given in inputs:
        path = Path(given)
        if path.is_dir():
            found = sorted(p for p in path.iterdir() if p.suffix.lower() in IMAGES)
        elif path.is_file():
            found = [path]
        else:
            pattern = str(path.relative_to(path.anchor))
            found = sorted(p for p in Path(path.anchor).glob(pattern) if p.is_file())
        if not found:
            kinds = ", ".join((*IMAGES, *FILMS, ROUND))
            raise UserError(f"there is no image file {given}, nor a film or round ({kinds})")
        sources.extend(map(_source, found))
    return sources


def _source(path: Path) -> Source:
    kind = path.suffix.lower()
    if kind in FILMS:
        try:
            film = _open_film(path)
        except UserError:  # said where it is read: the other files are not lost
            return Source(path, 0)
        count, fps = film.get(cv2.CAP_PROP_FRAME_COUNT), film.get(cv2.CAP_PROP_FPS)
        film.release()
        return Source(path, max(int(count), 0), fps if 0 < fps < 1000 else DEFAULT_FPS)
    if kind == ROUND:
        from datagen.recording import open_round

        index = open_round(path)
        return Source(path, index.result.frames, float(index.header.frequency_hz))
    return Source(path, 1)  # of another suffix, too: what a file is, its first bytes tell


def read_sources(
    sources: list[Source], camera: CameraParameters, lens: Lens = None
) -> Iterator[SourceImage]:
    """The images of all sources in order, in the size of `camera`, decoded on another thread."""
    items = (item for source in sources for item in _read(source, camera, lens))
    with ThreadPoolExecutor(1) as decoder:  # one thread: the order stays
        waiting = deque(decoder.submit(next, items, None) for _ in range(READ_AHEAD))
        while (item := waiting.popleft().result()) is not None:
            waiting.append(decoder.submit(next, items, None))
            yield item


def _read(source: Source, camera: CameraParameters, lens: Lens) -> Iterator[SourceImage]:
    kind = source.path.suffix.lower()
    if kind in FILMS:
        return _read_film(source, camera, lens)
    if kind == ROUND:
        return _read_round(source.path, camera)
    return _read_file(source.path, camera, lens)


def _read_file(path: Path, camera: CameraParameters, lens: Lens) -> Iterator[SourceImage]:
    try:
        if isinstance(lens, Rectification):
            image = lens.image(read_whole_image(path))
        else:
            image = read_image(path, camera, lens)
        yield SourceImage(str(path), image)
    except (ImageError, UserError) as error:
        yield SourceImage(str(path), None, str(error))


def _read_film(source: Source, camera: CameraParameters, lens: Lens) -> Iterator[SourceImage]:
    try:
        film = _open_film(source.path)
    except UserError as error:
        yield SourceImage(str(source.path), None, str(error))
        return
    number = 0
    try:
        while True:
            found, frame = film.read()
            if not found:
                break
            name = f"{source.path}#{number}"
            number += 1
            picture = cv2.cvtColor(frame, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
            try:
                if isinstance(lens, Rectification):
                    image = lens.image(picture)
                else:
                    image = crop_and_resize(picture, camera, lens)
            except ImageError as error:  # all frames are alike
                yield SourceImage(str(source.path), None, f"{source.path}: {error}")
                return
            yield SourceImage(name, image)
    finally:
        film.release()
    if number < source.count:
        yield SourceImage(
            str(source.path),
            None,
            f"{source.path} ends after {number} of {source.count} frames; those were used",
        )


def _read_round(path: Path, camera: CameraParameters) -> Iterator[SourceImage]:
    from datagen.recording import Frames, RoundInfo, open_round

    index = open_round(path)
    recorded = index.header.dataset_camera
    if recorded != camera:
        raise UserError(f"{path} was recorded with {recorded}, the model's camera is {camera}")
    info = RoundInfo.of(path, index.header, index.result, "test")
    frames = Frames([info], [index], recorded)
    labels = frames.labels
    for number in range(len(frames)):
        distances = dict(zip(tf.MARKINGS, labels.distances[number].tolist(), strict=True))
        truth = Truth(
            {name: None if np.isnan(d) else d for name, d in distances.items()},
            float(labels.angle[number]),
            float(labels.curvature[number]),
        )
        yield SourceImage(f"{path}#{number}", frames.image(number), truth=truth)


def _open_film(path: Path) -> Any:
    film = cv2.VideoCapture(str(path))
    if not film.isOpened():
        raise UserError(f"{path} cannot be opened as a film; check it with another player")
    return film
