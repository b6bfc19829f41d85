"""Where `mtlnet predict` takes images from: files, folders, patterns, films, rounds, recordings of
other programs, webcams and streams."""

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import trackfeatures as tf
from mtlnet.inference.image_decoding.decode import read_whole_image
from mtlnet.inference.rectification import Rectification
from mtlnet.predict.films import Film, read_film_header
from mtlnet.predict.kinds import Kind, bag_metadata, kind_of
from mtlnet.predict.pictures import Image, Lens, LensFinder, Picture, Pictures, fit
from mtlnet.predict.streams import Stream, is_live, open_stream, shown_name
from runtime.files import natural_key
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from datagen.recording import Frames, Labels
    from mtlnet.predict.recordings.recording import Recording

DEFAULT_FPS = 20.0
READ_AHEAD = 16
"""Decoded images that wait for the network at most."""
UNREMARKABLE = ("thumbs.db", "desktop.ini", "labels.csv", "camera.yaml")
MAX_NAMED = 5
"""Files named in a note."""

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

    source: str
    """The file, webcam or address."""
    frame: int | None
    """Of a film, stream, round or recording: the number of the frame, from 0."""
    image: Image | None
    """uint8 RGB (210, 280, 3)."""
    error: str = ""
    truth: Truth | None = None
    time_s: float | None = None
    """When it was taken, s: of a film or round since its start, else since 1970. None: unknown."""
    lens: Rectification | None = None
    """From its camera to the model's; None where it is the model's."""

    @property
    def name(self) -> str:
        """The source; where it has several images with the number of this one: `film.mp4#12`."""
        return self.source if self.frame is None else f"{self.source}#{self.frame}"


@dataclass(frozen=True)
class Source:
    """One file, webcam or address to take images from."""

    path: Path
    kind: Kind = Kind.IMAGE
    count: int = 1
    """Number of images; of a film what its header declares. 0: unknown."""
    fps: float = DEFAULT_FPS
    problem: str = ""
    """Why no image can be taken from it."""
    address: str = ""
    """Of a webcam or stream, without a password."""
    opened: "Stream | Recording | None" = None
    lens: Lens | LensFinder = None

    @property
    def name(self) -> str:
        """As it stands in tables and messages."""
        return self.address or str(self.path)

    @property
    def files(self) -> list[Path]:
        """What is read, and so must not be written to."""
        return list(self.path.iterdir()) if self.path.is_dir() else [self.path]


def find_sources(
    inputs: list[str], note: Note = lambda line: None, topic: str = ""
) -> list[Source]:
    """What arguments name: a file, those of a folder, those a pattern matches, a webcam by its
    number, a stream by its address.

    In natural order (`frame2` before `frame10`). What names nothing is a source with a problem.
    `note`: takes a line on what is left out: a folder's other files, and its subfolders. `topic`:
    of recordings; empty: the only one with pictures.
    """
    return [source for given in inputs for source in _find(given, note, topic)]


def _find(given: str, note: Note, topic: str) -> list[Source]:
    path = Path(given)
    if is_live(given):
        return [_stream(given)]
    if not given:  # Path takes it for the present folder
        return [Source(path, problem="the name of an input is empty; give a file or a folder")]
    try:
        if path.is_dir():
            if bag_metadata(path) is not None:
                return [_source(path, Kind.RECORDING, topic)]
            return _in_folder(path, note, topic)
        if path.is_file():
            return [
                _source(path, kind_of(path) or Kind.IMAGE, topic)
            ]  # says what its first bytes are
        if os.path.lexists(path):
            reason = "its target is missing" if path.is_symlink() else "a pipe or a device"
            return [Source(path, problem=f"{path} is no file ({reason}); give a file")]
        found = _in_order(p for p in _matches(path) if p.is_file())
    except (OSError, ValueError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        return [Source(path, problem=f"{given} cannot be read ({reason}); check name and mode")]
    if not found:
        return [Source(path, problem=f"there is no image file {given}, nor a film or round")]
    return _known(found, given, note, topic)


def _in_folder(folder: Path, note: Note, topic: str) -> list[Source]:
    entries = _in_order(folder.iterdir())
    files = [path for path in entries if path.is_file()]
    folders = [path for path in entries if path.is_dir() and not path.name.startswith(".")]
    if folders:
        note(f"{folder}: its folders are not searched: {_named(folders)}; give them by name")
    return _known(files, str(folder), note, topic)


def _matches(pattern: Path) -> Iterable[Path]:
    if pattern.name == "**":  # before Python 3.13 it matches folders only
        pattern /= "*"
    return Path(pattern.anchor).glob(str(pattern.relative_to(pattern.anchor)))


def _in_order(paths: Iterable[Path]) -> list[Path]:
    return sorted(paths, key=lambda path: [natural_key(part) for part in path.parts])


def _known(files: list[Path], given: str, note: Note, topic: str) -> list[Source]:
    """The sources among `files`; the others are noted, but for what is found beside images."""
    kinds = {path: kind_of(path) for path in files}
    sources = [_source(path, kind, topic) for path, kind in kinds.items() if kind is not None]
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


def _stream(given: str) -> Source:
    path, name = Path(given), shown_name(given)
    try:
        opened = open_stream(given)
    except UserError as error:
        return Source(path, Kind.STREAM, 0, problem=str(error), address=name)
    return Source(path, Kind.STREAM, 0, opened.fps or DEFAULT_FPS, address=name, opened=opened)


def _source(path: Path, kind: Kind, topic: str) -> Source:
    try:
        if kind is Kind.RECORDING:
            from mtlnet.predict.recordings.recording import open_recording

            found = open_recording(path, topic)
            return Source(path, kind, found.count, opened=found)
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
    except ModuleNotFoundError as error:
        needed = f"the package {error.name}, in `pip install driverview[recording]`"
        return Source(path, kind, 0, problem=f"{path} needs {needed}")
    return Source(path)


def _unreadable(path: Path, error: OSError) -> str:
    return f"{path} cannot be read ({error.strerror or error})"


def read_sources(
    sources: list[Source], camera: CameraParameters
) -> Generator[SourceImage, None, None]:
    """The images of all sources in order, in the size of `camera`, decoded on another thread.

    Close it to end a stream.
    """
    items = (item for source in sources for item in _read(source, camera))
    decoder = ThreadPoolExecutor(1)  # one thread: the order stays
    try:
        waiting = deque(decoder.submit(next, items, None) for _ in range(READ_AHEAD))
        while (item := waiting.popleft().result()) is not None:
            waiting.append(decoder.submit(next, items, None))
            yield item
    finally:
        decoder.shutdown(cancel_futures=True)  # a stream is not read on
        items.close()


def _read(source: Source, camera: CameraParameters) -> Iterator[SourceImage]:
    """The images of a source; what goes wrong is an item of its own, and ends that source only."""
    name = source.name
    read = {Kind.ROUND: _read_round, Kind.IMAGE: _read_file}.get(source.kind, _read_pictures)
    try:
        if source.problem:
            raise UserError(source.problem)
        yield from read(source, camera)
    except UserError as error:
        message = str(error)
        told = message if name in message else f"{name}: {message}"
        yield SourceImage(name, None, None, told)
    except OSError as error:
        yield SourceImage(name, None, None, _unreadable(source.path, error))


def _read_file(source: Source, camera: CameraParameters) -> Iterator[SourceImage]:
    lens = source.lens
    assert not isinstance(lens, LensFinder), "a file is one picture"
    image = fit(Picture(0, read_whole_image(source.path)), camera, lens)
    yield SourceImage(source.name, None, image, lens=_rectification(lens))


def _read_pictures(source: Source, camera: CameraParameters) -> Iterator[SourceImage]:
    """Of a film, a stream or a recording. An ImageError ends it: its pictures are all alike."""
    reader: Pictures = Film(source.path) if source.opened is None else source.opened
    for picture in reader.pictures():
        if picture.image is None:
            yield SourceImage(source.name, picture.number, None, picture.error)
            continue
        lens = source.lens
        if isinstance(lens, LensFinder):
            lens = lens.at(picture)
        yield SourceImage(
            source.name, picture.number, fit(picture, camera, lens), time_s=picture.time_s,
            lens=_rectification(lens),
        )  # fmt: skip
    if reader.fault:
        yield SourceImage(source.name, None, None, reader.fault)


def _rectification(lens: Lens) -> Rectification | None:
    return lens if isinstance(lens, Rectification) else None


def _read_round(source: Source, camera: CameraParameters) -> Iterator[SourceImage]:
    from datagen.recording import DatasetError, Frames, RoundInfo, UndecodableImage, open_round
    from mtlnet.data.model_labels import moved_rounds, round_rectification

    path = source.path
    if isinstance(source.lens, Rectification):
        raise UserError(f"{path}: --camera is for images and films; a round has its own camera")
    index = open_round(path)
    tf.require_version(index.header.definitions, str(path))
    recorded = index.header.dataset_camera
    if recorded != camera:
        raise UserError(f"{path} was recorded with {recorded}, the model's camera is {camera}")
    info = RoundInfo.of(path, index.header, index.result, "test")
    frames = Frames([info], [index], recorded)
    lens = round_rectification(info, camera) if moved_rounds(frames) else None
    labels: Labels | None = None
    with suppress(DatasetError):  # some are damaged: they are read one by one
        labels = frames.labels
    for number in range(len(frames)):
        try:
            image = frames.image(number)
        except UndecodableImage as error:
            yield SourceImage(source.name, number, None, str(error))
            continue
        if labels is not None:
            truth: Truth | None = _truth(labels, number)
        else:
            one = Frames([info], [index], recorded, np.array([number]))
            truth = _truth_of_one(one)
        time_s = number / index.header.frequency_hz
        yield SourceImage(source.name, number, image, truth=truth, time_s=time_s, lens=lens)


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
