"""Reads the images of files, films, streams and recordings in order. A second thread decodes each
image and converts it to the view of the model's camera."""

from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

import trackfeatures as tf
from mtlnet.inference.image_decoding.decode import read_whole_image
from mtlnet.inference.rectification import Rectification
from mtlnet.sources.films import Film
from mtlnet.sources.find import Source, unreadable
from mtlnet.sources.kinds import SourceKind
from mtlnet.sources.pictures import Image, Lens, LensFinder, Picture, Pictures, fit
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from datagen.recording import Frames, Labels

READ_AHEAD = 16
"""Maximum number of decoded images that wait for the network."""


@dataclass(frozen=True)
class Truth:
    """Labels of a recorded frame: distances in m by marking, angle in rad, and curvature of the
    road in 1/m, positive to the left."""

    distances_m: dict[str, float | None]
    angle_rad: float
    curvature: float


@dataclass(frozen=True)
class SourceImage:
    """One image at the model's size, or the reason why it cannot be used."""

    source: str
    """Name of the file or webcam, or address of the stream."""
    frame: int | None
    """Number of the frame in a film, stream, round or recording, from 0; None for a single
    image."""
    image: Image | None
    """Pixels uint8 RGB (210, 280, 3); None with an `error`."""
    error: str = ""
    truth: Truth | None = None
    time_s: float | None = None
    """Time of the image, s: since the start of a film or round, else since 1970. None: unknown."""
    lens: Rectification | None = None
    """Rectification from its camera to the model's; None where the model's camera took it."""

    @property
    def name(self) -> str:
        """Name of the source, with the frame's number if the source has several images, for example
        `film.mp4#12`."""
        return self.source if self.frame is None else f"{self.source}#{self.frame}"


def read_sources(
    sources: list[Source], camera: CameraParameters
) -> Generator[SourceImage, None, None]:
    """Yield the images of all sources in order, at the size of the model's `camera`, decoded on
    another thread.

    Close the generator to end a stream.
    """
    items = (item for source in sources for item in _read(source, camera))
    decoder = ThreadPoolExecutor(1)  # one thread keeps the order
    try:
        waiting = deque(decoder.submit(next, items, None) for _ in range(READ_AHEAD))
        while (item := waiting.popleft().result()) is not None:
            waiting.append(decoder.submit(next, items, None))
            yield item
    finally:
        decoder.shutdown(cancel_futures=True)  # stop reading a stream
        items.close()


def _read(source: Source, camera: CameraParameters) -> Iterator[SourceImage]:
    """The images of a source. An error becomes an item and ends only this source."""
    name = source.name
    read = {SourceKind.ROUND: _read_round, SourceKind.IMAGE: _read_file}.get(
        source.kind, _read_pictures
    )
    try:
        if source.problem:
            raise UserError(source.problem)
        yield from read(source, camera)
    except UserError as error:
        message = str(error)
        told = message if name in message else f"{name}: {message}"
        yield SourceImage(name, None, None, told)
    except OSError as error:
        yield SourceImage(name, None, None, unreadable(source.path, error))


def _read_file(source: Source, camera: CameraParameters) -> Iterator[SourceImage]:
    lens = source.lens
    assert not isinstance(lens, LensFinder), "a file is one picture"
    image = fit(Picture(0, read_whole_image(source.path)), camera, lens)
    yield SourceImage(source.name, None, image, lens=_rectification(lens))


def _read_pictures(source: Source, camera: CameraParameters) -> Iterator[SourceImage]:
    """The images of a film, stream or recording. An ImageError ends the source, because all its
    pictures have the same camera."""
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
    if source.lens is not None:
        raise UserError(
            f"{path}: --camera and --fov-y-deg are for images and films; a round has its own camera"
        )
    index = open_round(path)
    tf.require_version(index.header.definitions, str(path))
    recorded = index.header.dataset_camera
    if recorded != camera:
        raise UserError(f"{path} was recorded with {recorded}, the model's camera is {camera}")
    info = RoundInfo.of(path, index.header, index.result, "test")
    frames = Frames([info], [index], recorded)
    lens = round_rectification(info, camera) if moved_rounds(frames) else None
    labels: Labels | None = None
    with suppress(DatasetError):  # if some labels are damaged, they are read one by one below
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
    """Labels of a frame; None where they are damaged."""
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
