"""What can be wrong with one recorded round, found level by level.

quick: its end, its index and its counts. full: every byte by CRC and hash, time, images paired with
labels. deep: every image and message decoded, labels against the definitions.
"""

import hashlib
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

import trackfeatures as tf

from . import topics
from .agreement import disagreements
from .checksums import wrong_checksums
from .dataset import IMAGE_DATA
from .encoding import decode_into
from .errors import DatasetError
from .folder import RoundState, file_sha256
from .index import DAMAGE, RoundIndex, open_round
from .labels import read_labels
from .wire import bytes_field

LEVELS = ("quick", "full", "deep")


def check_round(path: Path, level: str, state: RoundState | None) -> tuple[int, list[str]]:
    """Frames found, and the problems, one line each; never raises for a bad file."""
    if level not in LEVELS:
        raise DatasetError(f"there is no level {level!r}; choose {', '.join(LEVELS)}")
    try:
        index = open_round(path)
    except DatasetError as error:
        return 0, [str(error)]
    except OSError as error:
        return 0, [unreadable(path, error)]
    frames = len(index.messages[topics.CAMERA].log_time)
    problems: list[str] = []
    try:
        problems += _quick(index, state)
        if level != "quick":
            problems += _full(index, state)
        if level == "deep":
            problems += _deep(index)
    except OSError as error:
        problems.append(f"cannot be read ({error.strerror})")
    return frames, [f"{path.name}: {problem}" for problem in problems]


def unreadable(path: Path, error: OSError) -> str:
    return f"{path} cannot be read ({error.strerror})"


def content_hash(index: RoundIndex) -> str:
    """The hash over images and labels that the writer took."""
    digest = hashlib.sha256()
    images, labels = index.messages[topics.CAMERA], index.messages[topics.LABELS]
    for i in range(len(images.log_time)):
        digest.update(bytes_field(images.payload(i), IMAGE_DATA))
        digest.update(labels.payload(i))
    return digest.hexdigest()


def _quick(index: RoundIndex, state: RoundState | None) -> Iterator[str]:
    for topic, messages in index.messages.items():
        if len(messages.log_time) != index.result.frames:
            yield f"{len(messages.log_time)} messages on {topic}, {index.result.frames} recorded"
    if index.header.definitions != tf.VERSION:
        yield (
            f"recorded under definitions {index.header.definitions}, this program has {tf.VERSION}"
        )
    if state is None:
        yield "no state file holds its hashes"
    elif index.path.stat().st_size != state.bytes:
        yield f"{index.path.stat().st_size} bytes, {state.bytes} were written"


def _full(index: RoundIndex, state: RoundState | None) -> Iterator[str]:
    if state is not None and file_sha256(index.path) != state.sha256:
        yield "its bytes are not those that were written (sha256 differs)"
    yield from wrong_checksums(index.path)
    yield from _walk(index, decode=False)
    for topic, messages in index.messages.items():
        if (np.diff(messages.log_time) <= 0).any():
            yield f"time does not increase on {topic}"
    try:
        read_labels(index, 0)
        if content_hash(index) != index.result.content_hash:
            yield "its images and labels are not those that were recorded (content hash differs)"
    except (DatasetError, ValueError, IndexError) as error:
        yield str(error)


def _deep(index: RoundIndex) -> Iterator[str]:
    yield from _walk(index, decode=True)
    camera = index.header.camera
    image = np.empty((camera.height, camera.width, 3), np.uint8)
    messages = index.messages[topics.CAMERA]
    for i in range(len(messages.log_time)):
        try:
            decode_into(bytes_field(messages.payload(i), IMAGE_DATA), image)
        except ValueError as error:
            yield f"image {i} cannot be decoded: {error}"
    try:
        labels = read_labels(index, 0)
    except DatasetError:
        return  # already told
    yield from disagreements(labels, index.header.lanes, index.header.lane_width_m)


def _walk(index: RoundIndex, decode: bool) -> Iterator[str]:
    """Every chunk by the official reader: CRCs and counts; with `decode`, every message parsed."""
    counts = dict.fromkeys(topics.MESSAGE_TYPES, 0)
    names: dict[int, str] = {}
    size = index.path.stat().st_size
    try:
        with index.path.open("rb") as stream:
            for record in StreamReader(stream, emit_chunks=True, record_size_limit=size).records:
                if not isinstance(record, Chunk):
                    continue
                if not record.compression and zlib.crc32(record.data) != record.uncompressed_crc:
                    yield f"damaged near {_seconds(record.message_start_time)} (a chunk's CRC)"
                for part in breakup_chunk(record):
                    if isinstance(part, Channel):
                        names[part.id] = part.topic
                    elif isinstance(part, Message):
                        topic = names[part.channel_id]
                        counts[topic] = counts.get(topic, 0) + 1
                        if decode and topic in topics.MESSAGE_TYPES:
                            topics.MESSAGE_TYPES[topic].FromString(part.data)
    except (*DAMAGE, DecodeError) as error:
        yield f"cannot be read to its end: {error or type(error).__name__}"
        return
    for topic in topics.EVERY_STEP:
        if counts[topic] != index.result.frames:
            yield f"{counts[topic]} messages on {topic}, expected {index.result.frames}"


def _seconds(log_time: int) -> str:
    return f"{(log_time - topics.EPOCH_NS) / topics.NANOSECONDS:.2f} s"
