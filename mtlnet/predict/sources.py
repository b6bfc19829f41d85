"""Where `mtlnet predict` takes images from: files, folders, glob patterns, films and rounds."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.image_decoding.decode import (
    crop_and_resize,
    read_image,
    read_whole_image,
)
from mtlnet.inference.rectification import Rectification
from mtlnet.predict.films import Film, read_film_header
from mtlnet.predict.kinds import Kind, kind_of
from runtime.files import natural_key
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from datagen.recording import Frames, Labels

DEFAULT_FPS = 20.0
READ_AHEAD = 16
"""Decoded images that wait for the network at most."""
UNREMARKABLE = ("thumbs.db", "desktop.ini", "labels.csv", "camera.yaml")
MAX_NAMED = 5
"""Files named in a note."""

Image = NDArray[np.uint8]
Lens = Rectification | float | None
"""Of images and films: their camera, or its vertical field of view in degrees; None: the model's.
"""
Note = Callable[[str], None]


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

    file: Path
    frame: int | None
    """Of a film or a round: the number of the frame, from 0."""
    image: Image | None
    """uint8 RGB (210, 280, 3)."""
    error: str = ""
    truth: Truth | None = None

    @property
    def name(self) -> str:
        """The file; for a film or a round with the number of the frame: `film.mp4#12`."""
        return f"{self.file}" if self.frame is None else f"{self.file}#{self.frame}"


@dataclass(frozen=True)
class Source:
    """One file to take images from."""

    path: Path
    kind: Kind = Kind.IMAGE
    count: int = 1
    """Number of images; of a film what its header declares. 0: unknown."""
    fps: float = DEFAULT_FPS
    problem: str = ""
    """Why no image can be taken from it."""


def find_sources(inputs: list[str], note: Note = lambda line: None) -> list[Source]:
    """The files that arguments name: a file, those of a folder, or those a pattern matches.

    In natural order (`frame2` before `frame10`). What names nothing is a source with a problem.
    `note`: takes a line on what is left out: a folder's other files, and its subfolders.
    """
    return [source for given in inputs for source in _find(given, note)]


def _find(given: str, note: Note) -> list[Source]:
    path = Path(given)
    if not given:  # Path takes it for the present folder
        return [Source(path, problem="the name of an input is empty; give a file or a folder")]
    try:
        if path.is_dir():
            return _in_folder(path, note)
        if path.is_file():
            return [_source(path, kind_of(path) or Kind.IMAGE)]  # says what its first bytes are
        if os.path.lexists(path):
            reason = "its target is missing" if path.is_symlink() else "a pipe or a device"
            return [Source(path, problem=f"{path} is no file ({reason}); give a file")]
        found = _in_order(p for p in _matches(path) if p.is_file())
    except (OSError, ValueError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        return [Source(path, problem=f"{given} cannot be read ({reason}); check name and mode")]
    if not found:
        return [Source(path, problem=f"there is no image file {given}, nor a film or round")]
    return _known(found, given, note)


def _in_folder(folder: Path, note: Note) -> list[Source]:
    entries = _in_order(folder.iterdir())
    files = [path for path in entries if path.is_file()]
    folders = [path for path in entries if path.is_dir() and not path.name.startswith(".")]
    if folders:
        note(f"{folder}: its folders are not searched: {_named(folders)}; give them by name")
    return _known(files, str(folder), note)


def _matches(pattern: Path) -> Iterable[Path]:
    if pattern.name == "**":  # before Python 3.13 it matches folders only
        pattern /= "*"
    return Path(pattern.anchor).glob(str(pattern.relative_to(pattern.anchor)))


def _in_order(paths: Iterable[Path]) -> list[Path]:
    return sorted(paths, key=lambda path: [natural_key(part) for part in path.parts])


def _known(files: list[Path], given: str, note: Note) -> list[Source]:
    """The sources among `files`; the others are noted, but for what is found beside images."""
    kinds = {path: kind_of(path) for path in files}
    sources = [_source(path, kind) for path, kind in kinds.items() if kind is not None]
    others = [path for path, kind in kinds.items() if kind is None and not _is_unremarkable(path)]
    if others:
        note(f"{given}: left out, neither image nor film nor round: {_named(others)}")
    if sources:
        return sources
    return [Source(Path(given), problem=f"there is no image in {given}, nor a film or round")]


def _is_unremarkable(path: Path) -> bool:
    return path.name.startswith(".") or path.name.lower() in UNREMARKABLE


def _named(paths: list[Path]) -> str:
    more = f" and {len(paths) - MAX_NAMED} more" if len(paths) > MAX_NAMED else ""
    return ", ".join(path.name for path in paths[:MAX_NAMED]) + more


def _source(path: Path, kind: Kind) -> Source:
    try:
        if kind is Kind.FILM:
            header = read_film_header(path)
            return Source(path, kind, header.count, header.fps or DEFAULT_FPS)
        if kind is Kind.ROUND:
            from datagen.recording import open_round

            index = open_round(path)
            return Source(path, kind, index.result.frames, float(index.header.frequency_hz))
    except UserError as error:  # said where it is read: the other files are not lost
        return Source(path, kind, 0, problem=str(error))
    except OSError as error:
        return Source(path, kind, 0, problem=_unreadable(path, error))
    return Source(path)


def _unreadable(path: Path, error: OSError) -> str:
    return f"{path} cannot be read ({error.strerror or error})"


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
    """The images of a source; what goes wrong is an item of its own, and ends that source only."""
    path = source.path
    read = {Kind.FILM: _read_film, Kind.ROUND: _read_round, Kind.IMAGE: _read_file}[source.kind]
    try:
        if source.problem:
            raise UserError(source.problem)
        yield from read(path, camera, lens)
    except UserError as error:
        message = str(error)
        told = message if str(path) in message else f"{path}: {message}"
        yield SourceImage(path, None, None, told)
    except OSError as error:
        yield SourceImage(path, None, None, _unreadable(path, error))


def _read_file(path: Path, camera: CameraParameters, lens: Lens) -> Iterator[SourceImage]:
    if isinstance(lens, Rectification):
        yield SourceImage(path, None, lens.image(read_whole_image(path)))
    else:
        yield SourceImage(path, None, read_image(path, camera, lens))


def _read_film(path: Path, camera: CameraParameters, lens: Lens) -> Iterator[SourceImage]:
    film = Film(path)
    for number, picture in film.frames():
        if isinstance(lens, Rectification):
            image = lens.image(picture)
        else:
            image = crop_and_resize(picture, camera, lens)  # an error ends the film: all are alike
        yield SourceImage(path, number, image)
    if film.fault:
        yield SourceImage(path, None, None, film.fault)


def _read_round(path: Path, camera: CameraParameters, lens: Lens) -> Iterator[SourceImage]:
    from datagen.recording import DatasetError, Frames, RoundInfo, UndecodableImage, open_round

    if isinstance(lens, Rectification):
        raise UserError(f"{path}: --camera is for images and films; a round has its own camera")
    index = open_round(path)
    tf.require_version(index.header.definitions, str(path))
    recorded = index.header.dataset_camera
    if recorded != camera:
        raise UserError(f"{path} was recorded with {recorded}, the model's camera is {camera}")
    info = RoundInfo.of(path, index.header, index.result, "test")
    frames = Frames([info], [index], recorded)
    labels: Labels | None = None
    with suppress(DatasetError):  # some are damaged: they are read one by one
        labels = frames.labels
    for number in range(len(frames)):
        try:
            image = frames.image(number)
        except UndecodableImage as error:
            yield SourceImage(path, number, None, str(error))
            continue
        if labels is not None:
            truth: Truth | None = _truth(labels, number)
        else:
            one = Frames([info], [index], recorded, np.array([number]))
            truth = _truth_of_one(one)
        yield SourceImage(path, number, image, truth=truth)


def _truth_of_one(frame: "Frames") -> Truth | None:
    """The labels of a frame; None where they are damaged."""
    from datagen.recording import DatasetError

    try:
        return _truth(frame.labels, 0)
    except DatasetError:
        return None


def _truth(labels: "Labels", row: int) -> Truth:
    distances = dict(zip(tf.MARKINGS, labels.distances[row].tolist(), strict=True))
    return Truth(
        {name: None if np.isnan(d) else d for name, d in distances.items()},
        float(labels.angle[row]),
        float(labels.curvature[row]),
    )
