"""Reads the frames of a round with parsed messages, for `datagen export` and `datagen view`."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from datagen.recording.dataset import IMAGE_DATA
from datagen.recording.errors import DatasetError
from datagen.recording.labels import light_per_frame
from datagen.recording.mcap.index import DAMAGE_ERRORS, RoundIndex, open_round
from datagen.recording.mcap.protobuf_wire import bytes_field
from datagen.recording.schema.proto.driverview_pb2 import Command, TrackFeatures, VehicleState
from datagen.recording.schema.topics import (
    CAMERA,
    COMMAND,
    EGO_STATE,
    LABELS,
    MESSAGE_TYPES,
    seconds,
)

TOPICS = (CAMERA, LABELS, EGO_STATE, COMMAND)

Value = float | int | str | list[float] | None


@dataclass(frozen=True, slots=True)
class Step:
    """One frame: image, labels, vehicle state and command. `image` is encoded and not copied."""

    number: int
    time_s: float
    image: memoryview
    labels: TrackFeatures
    ego: VehicleState
    command: Command
    light: str


@dataclass(frozen=True)
class Steps:
    """The frames of a round as a sequence: `steps[0]`, `len(steps)`, `for step in steps`."""

    index: RoundIndex

    @staticmethod
    def open(path: Path, topics: tuple[str, ...] = TOPICS) -> "Steps":
        """Open a round for reading `topics`. Raises DatasetError unless every image has a label, a
        state and a command, or if a message index is damaged."""
        steps = Steps(open_round(path, topics))
        times = steps.index.log_times(CAMERA)
        for topic in TOPICS[1:]:
            if not np.array_equal(steps.index.log_times(topic), times):
                raise DatasetError(
                    f"{path}: its images do not pair with what is on {topic}; run "
                    "`datagen verify` on the dataset and record the round again"
                )
        return steps

    def __len__(self) -> int:
        return len(self.times_s)

    def __getitem__(self, number: int) -> Step:
        return Step(
            number,
            self.times_s[number],
            bytes_field(self.payload(CAMERA, number), IMAGE_DATA),
            self.message(LABELS, number),
            self.message(EGO_STATE, number),
            self.message(COMMAND, number),
            self.lights[number],
        )

    def __iter__(self) -> Iterator[Step]:
        return (self[number] for number in range(len(self)))

    def message(self, topic: str, number: int) -> Any:
        """Parse message `number` of an opened topic and return the protobuf object. Raises
        DatasetError if the message is damaged."""
        try:
            return MESSAGE_TYPES[topic].FromString(bytes(self.payload(topic, number)))
        except DAMAGE_ERRORS as error:
            raise self._damaged(topic, number, error) from error

    def payload(self, topic: str, number: int) -> memoryview:
        """Return the bytes of message `number` of a topic. Raises DatasetError if its chunk is
        damaged."""
        try:
            return self.index.messages[topic].payload(number)
        except DAMAGE_ERRORS as error:
            raise self._damaged(topic, number, error) from error

    @cached_property
    def lights(self) -> list[str]:
        """Name of the light at each frame."""
        lights: list[str] = light_per_frame(self.index).tolist()
        return lights

    @cached_property
    def times_s(self) -> list[float]:
        """Simulated time of each frame since the start of the round, s."""
        times = self.index.messages[CAMERA].log_time.tolist()
        if not times:
            raise DatasetError(f"{self.index.path} has no frames; record the round again")
        return [seconds(time) for time in times]

    def _damaged(self, topic: str, number: int, error: Exception) -> DatasetError:
        return DatasetError(
            f"{self.index.path}: message {number} on {topic} cannot be read ({error}); run "
            "`datagen verify` on the dataset and record the round again"
        )


def values(message: Any) -> dict[str, Value]:
    """Return the fields of a protobuf message by name. Absent fields are None; enum values are
    lower-case names."""
    return {f.name: _value(message, f) for f in message.DESCRIPTOR.fields}


def _value(message: Any, field: Any) -> Value:
    value = getattr(message, field.name)
    if field.has_presence and not message.HasField(field.name):
        return None
    if field.enum_type is not None:
        return str(field.enum_type.values_by_number[value].name).lower()
    found: Value = list(value) if field.is_repeated else value
    return found
