"""Checks of one recorded round, in three levels.

quick: footer, index and message counts. full: every byte by CRC and SHA-256, log times, images
paired with labels. deep: every image and message decoded, labels compared with the definitions.
"""

import hashlib
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

import trackfeatures as tf
from datagen.recording.dataset import IMAGE_DATA
from datagen.recording.errors import DatasetError
from datagen.recording.folder import RoundState
from datagen.recording.images import decode_into
from datagen.recording.integrity.label_consistency import label_problems
from datagen.recording.labels import read_labels
from datagen.recording.mcap.index import RoundIndex, open_round
from datagen.recording.mcap.protobuf_wire import bytes_field
from datagen.recording.mcap.scan import Scan, scan
from datagen.recording.schema import topics
from datagen.recording.schema.proto.driverview_pb2 import VehicleState

LEVELS = ("quick", "full", "deep")
MAX_LISTED = 5  # problems of one kind in one round


def check_round(path: Path, level: str, state: RoundState | None) -> tuple[int, list[str]]:
    """Check the round file at `path`; return its number of frames and its problems, one line each.

    A damaged file raises no exception. Raises DatasetError for an unknown `level`.
    """
    if level not in LEVELS:
        raise DatasetError(f"there is no level {level!r}; choose {', '.join(LEVELS)}")
    try:
        index = open_round(path)
    except DatasetError as error:
        return 0, [str(error)]
    except OSError as error:
        return 0, [describe_read_error(path, error)]
    problems: list[str] = []
    try:
        problems += _quick(index, state)
        if level != "quick":
            problems += _full(index, state, _MessageChecker(index, deep=level == "deep"))
        if level == "deep":
            problems += _labels(index)
    except OSError as error:
        problems.append(f"cannot be read ({error.strerror})")
    return len(index.messages[topics.CAMERA]), [f"{path.name}: {p}" for p in problems]


def describe_read_error(path: Path, error: OSError) -> str:
    """Return the line of the report for a file that the system cannot read."""
    return f"{path} cannot be read ({error.strerror})"


def _quick(index: RoundIndex, state: RoundState | None) -> Iterator[str]:
    header, result = index.header, index.result
    for topic, messages in index.messages.items():
        if len(messages) != result.frames:
            yield f"{len(messages)} messages on {topic}, {result.frames} recorded"
    if header.definitions != tf.VERSION:
        yield (
            f"recorded under definitions {header.definitions}, this program has {tf.VERSION}; "
            "record it again with this program"
        )
    if state is None:
        yield "no state file holds its hashes"
        return
    expected = {
        "id": header.id,
        "bytes": index.path.stat().st_size,
        "frames": result.frames,
        "content_hash": result.content_hash,
        "definitions": header.definitions,
    }
    for name, value in expected.items():
        if (stated := getattr(state, name)) != value:
            yield f"its {name} is {value}, its state file says {stated}"


def _full(index: RoundIndex, state: RoundState | None, checker: "_MessageChecker") -> Iterator[str]:
    found = scan(index.path, checker.on_message)
    if state is not None and found.sha256 != state.sha256:
        yield "its bytes are not those that were written (sha256 differs)"
    yield from found.problems
    if index.summary is not None and found.chunks != index.summary.chunks:
        yield "its index does not match its chunks"
    yield from _times(index, found)
    yield from checker.problems()
    if checker.content.hexdigest() != index.result.content_hash:
        yield "its images and labels are not those that were recorded (content hash differs)"


def _times(index: RoundIndex, found: Scan) -> Iterator[str]:
    """Yield a problem for each topic of EVERY_STEP without exactly one message per frame or with a
    wrong log time, and for each topic whose log times do not increase. `index` is the opened round,
    `found` the result of its scan."""
    frames, hertz = index.result.frames, index.header.frequency_hz
    clock = [topics.log_time_ns(step, hertz) for step in range(frames)]
    if index.recovery is not None:  # frames are missing, so compare with the times of the images
        clock = found.times.get(topics.CAMERA, [])
    for topic in topics.EVERY_STEP:
        times = found.times.get(topic, [])
        if len(times) != frames:
            yield f"{len(times)} messages on {topic}, expected {frames}"
        elif times != clock:
            step = next(i for i, (a, b) in enumerate(zip(times, clock, strict=True)) if a != b)
            yield (
                f"frame {step} on {topic} is at {topics.seconds(times[step]):.3f} s, "
                f"expected at {topics.seconds(clock[step]):.3f} s"
            )
    for topic, times in found.times.items():
        if any(b <= a for a, b in pairwise(times)):
            yield f"time does not increase on {topic}"


def _labels(index: RoundIndex) -> Iterator[str]:
    try:
        labels = read_labels(index, 0)
    except DatasetError as error:
        yield str(error)
        return
    states = index.messages[topics.EGO_STATE]
    roll = np.array(
        [VehicleState.FromString(bytes(states.payload(i))).roll for i in range(len(labels))]
    )
    header = index.header
    yield from label_problems(labels, roll, header.lanes, header.lane_width_m, header.line_offsets)


class _MessageChecker:
    """Checks each message of a round in `on_message`: it hashes images and labels and, with `deep`,
    decodes every message and image."""

    def __init__(self, index: RoundIndex, *, deep: bool) -> None:
        self.content = hashlib.sha256()
        self._deep = deep
        self._wrong: dict[str, list[str]] = {}
        camera = index.header.camera
        self._image = np.empty((camera.height, camera.width, 3), np.uint8)

    def on_message(self, topic: str, log_time: int, payload: memoryview) -> None:
        try:
            if topic == topics.LABELS:
                self.content.update(payload)
            elif topic == topics.CAMERA:
                self._check_image(log_time, payload)
            if self._deep and topic in topics.MESSAGE_TYPES:
                self._decode(topic, log_time, payload)
        except (ValueError, DecodeError) as error:
            at = f"{topics.seconds(log_time):.2f} s"
            self._wrong.setdefault(topic, []).append(f"{topic} at {at}: {error}")

    def problems(self) -> Iterator[str]:
        for found in self._wrong.values():
            yield from found[:MAX_LISTED]
            if len(found) > MAX_LISTED:
                yield f"... and {len(found) - MAX_LISTED} more of this topic"

    def _check_image(self, log_time: int, payload: memoryview) -> None:
        data = bytes_field(payload, IMAGE_DATA)
        self.content.update(data)
        if self._deep:
            decode_into(data, self._image)

    def _decode(self, topic: str, log_time: int, payload: memoryview) -> None:
        message: Any = topics.MESSAGE_TYPES[topic].FromString(bytes(payload))
        if topic == topics.CAMERA and message.timestamp.ToNanoseconds() != log_time:
            raise ValueError("the image has another timestamp than its message")
