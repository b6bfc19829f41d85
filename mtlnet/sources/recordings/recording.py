"""Reads the pictures of a recording: chooses the topic and decodes its messages in order."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from mtlnet.inference.image_decoding.errors import ImageError
from mtlnet.sources.pictures import Picture, other_size
from mtlnet.sources.recordings.cameras import calibration_topic, camera_of
from mtlnet.sources.recordings.coded_film import CodedFilm, Packet
from mtlnet.sources.recordings.containers import Container, names_of, open_container
from mtlnet.sources.recordings.images import (
    IMAGES,
    NANOSECONDS,
    VIDEO,
    picture_of,
    reader_of,
    time_of,
)
from mtlnet.sources.recordings.topic import Topic
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

KNOWN = ", ".join(IMAGES)
TIMED_PICTURES = 41
MAX_FPS, LONGEST_STEP_S = 1000.0, 10.0
"""Limits of the rate and of the mean time between pictures, beyond which the rate counts as
unknown."""


@dataclass
class Recording:
    """The pictures of one `topic` of a recording, which has the given `topics`. `fault`, set after
    the last picture, describes the recording's fault; empty if it has none."""

    path: Path
    container: Container
    topic: Topic
    topics: list[Topic]
    fault: str = ""

    @property
    def count(self) -> int:
        """Number of pictures; 0 if it is unknown."""
        return self.topic.count or 0

    def fps(self) -> float:
        """Return the mean number of pictures per second, from the log times of the first
        `TIMED_PICTURES`; 0 if it is unknown."""
        messages = islice(self.container.messages(self.topic.name), TIMED_PICTURES)
        times_ns = [time_ns for time_ns, _ in messages]
        if len(times_ns) < 2:
            return 0.0
        step_s = (times_ns[-1] - times_ns[0]) / NANOSECONDS / (len(times_ns) - 1)
        return 1 / step_s if 1 / MAX_FPS < step_s < LONGEST_STEP_S else 0.0

    def pictures(self) -> Iterator[Picture]:
        """Yields each message's picture, numbered from 0, with the time in its header, or its log
        time if the header has none.

        A message that cannot be decoded becomes a picture with an error; in a `CompressedVideo` it
        is left out, and counted in `fault`. A picture of another size than the first ends the
        iteration, with a fault.
        """
        if self.topic.schema == VIDEO:
            film = CodedFilm(f"{self.path} {self.topic.name}")
            yield from film.pictures(self._packets())
            self.fault = self.container.fault or film.fault
            return
        first: tuple[int, int] | None = None
        for number, (time_ns, data) in enumerate(self.container.messages(self.topic.name)):
            picture = self._picture(number, time_ns, data)
            if picture.image is not None:
                size = (picture.image.shape[1], picture.image.shape[0])
                first = first or size
                if size != first:
                    self.fault = other_size(str(self.path), number, size, first)
                    return
            yield picture
        self.fault = self.container.fault

    def camera(self, mount: CameraParameters) -> tuple[CameraParameters | None, str]:
        """Return the camera that the recording states, with position and angles of the camera
        `mount`, and a line of text about the camera.

        If this camera cannot be used, returns None and a line with the reason. If the recording
        states no camera, returns None and an empty line.
        """
        topic = calibration_topic(self.topic.name, self.topics)
        if topic is None:
            return None, ""
        read = reader_of(topic.schema, topic.encoding)
        try:
            if read is None:
                raise UserError(f"its encoding {topic.encoding!r} is not read")
            _, data = next(self.container.messages(topic.name))
            camera = camera_of(read(data), self.topic.name, mount)
        except (UserError, StopIteration) as error:
            return None, (
                f"{self.path}: {topic.name} is not used: {error}; the model's own camera is "
                "taken: give --camera"
            )
        return camera, (
            f"{self.path}: matrix and distortion come from {topic.name}, the mount is the "
            f"model's ({camera.height_above_road_m:g} m above the road, pitch "
            f"{camera.pitch_deg:g} degrees); --camera gives another camera"
        )

    def _reader(self) -> Callable[[bytes], Any]:
        read = reader_of(self.topic.schema, self.topic.encoding)
        assert read is not None, "topics of other kinds are not chosen"
        return read

    def _picture(self, number: int, time_ns: int, data: bytes) -> Picture:
        try:
            message = self._reader()(data)
            image = picture_of(message, self.topic.schema)
        except ImageError as error:
            where = f"{self.path}#{number} ({self.topic.name})"
            return Picture(number, None, time_ns / NANOSECONDS, error=f"{where}: {error}")
        return Picture(number, image, time_of(message) or time_ns / NANOSECONDS)

    def _packets(self) -> Iterator[Packet | ImageError]:
        read = self._reader()
        for time_ns, data in self.container.messages(self.topic.name):
            try:
                message = read(data)
            except ImageError as error:
                yield error
                continue
            yield time_of(message) or time_ns / NANOSECONDS, message.format, message.data


def open_recording(path: Path, topic: str = "") -> Recording:
    """Open the recording at `path`, to read the pictures of `topic`; empty: of the only topic with
    pictures.

    Raises UserError if `topic` does not exist or has no pictures, or if it is empty and not exactly
    one topic has pictures; UserError or OSError for an unreadable recording.
    """
    container = open_container(path)
    topics = container.topics()
    images = [t for t in topics if reader_of(t.schema, t.encoding) and t.schema in IMAGES]
    if topic:
        found = next((t for t in topics if t.name == topic), None)
        if found is None:
            raise UserError(
                f"{path} has no topic {topic}; its topics with pictures are {names_of(images)}"
            )
        if found not in images:
            raise UserError(
                f"{found} of {path} in {found.encoding} is not a supported picture ({KNOWN}); "
                f"its topics with pictures are {names_of(images)}"
            )
        return Recording(path, container, found, topics)
    if not images:
        raise UserError(
            f"{path} holds no pictures that are read ({KNOWN}); its topics are {names_of(topics)}"
        )
    if len(images) > 1:
        raise UserError(
            f"{path} has several topics with pictures: {names_of(images)}; choose one with --topic"
        )
    return Recording(path, container, images[0], topics)
