"""Writes one round as an MCAP file. The same frames give the same bytes on any machine."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from datagen.recording.frame import Frame
from datagen.recording.images import encode
from datagen.recording.round_metadata import (
    RESULT_METADATA,
    ROUND_METADATA,
    RoundHeader,
    RoundResult,
)
from datagen.recording.schema import messages, topics


class RoundWriter:
    """Writes a round frame by frame; `finish` completes the file. A `with` block closes the file.

    `scene`: polylines of the track by name, each (N, 3) in m in the world frame.
    """

    def __init__(
        self, path: Path, header: RoundHeader, scene: Mapping[str, NDArray[np.float64]]
    ) -> None:
        self.path = path
        self.header = header
        self.frames = 0
        self._content = hashlib.sha256()
        self._file = RoundFile(path, header)
        start = topics.log_time_ns(0, header.frequency_hz)
        track = messages.track_scene(scene, messages.timestamp(start))
        self._add(topics.TRACK_SCENE, start, track)

    def add(self, frame: Frame) -> None:
        """Append a frame: one message to each topic."""
        header = self.header
        time = topics.log_time_ns(self.frames, header.frequency_hz)
        stamp = messages.timestamp(time)
        image = encode(frame.image, header.codec)
        labels = messages.labels(frame)
        self._content.update(image)
        self._content.update(labels)
        if self.frames % header.frequency_hz == 0:
            self._add(topics.CALIBRATION, time, messages.calibration(header.camera, stamp))
        self._add(topics.CAMERA, time, messages.compressed_image(image, header.codec, stamp))
        self._add(topics.ANNOTATIONS, time, messages.annotations(frame, stamp))
        self._add(topics.LABELS, time, labels)
        self._add(topics.EGO_STATE, time, messages.ego_state(frame.ego))
        self._add(topics.SENSORS, time, messages.sensors(frame.sensors))
        self._add(topics.COMMAND, time, messages.command(frame.command))
        self._add(topics.TRAFFIC, time, messages.traffic(frame, stamp))
        self._add(topics.TRANSFORMS, time, messages.transforms(frame.ego, header.camera, stamp))
        self.frames += 1

    def finish(
        self,
        laps: int = 0,
        resets: int = 0,
        distance_m: float = 0.0,
        mean_speed_kmh: float = 0.0,
    ) -> RoundResult:
        """Write the result and the index, close the file, and return the result: the totals of the
        round, that is, the numbers of laps and resets, the distance in m and the mean speed in
        km/h."""
        result = RoundResult(
            frames=self.frames,
            content_hash=self._content.hexdigest(),
            laps=laps,
            resets=resets,
            distance_m=distance_m,
            mean_speed_kmh=mean_speed_kmh,
        )
        self._file.add_metadata(RESULT_METADATA, result.to_metadata())
        self._file.finish()
        return result

    def __enter__(self) -> "RoundWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def _add(self, topic: str, time: int, data: bytes) -> None:
        self._file.add(topic, time, self.frames, data)


# Estimates for the chunk size: image bytes per pixel, and bytes per frame of all other topics.
BYTES_PER_PIXEL = {"jpeg": 0.5, "png": 1.8}
OTHER_BYTES = 6_000


class RoundFile:
    """Writes serialised messages to an MCAP file; `finish` completes the file. A `with` block
    closes it."""

    def __init__(self, path: Path, header: RoundHeader) -> None:
        self._stream = path.open("wb")
        self._mcap = Writer(
            self._stream,
            chunk_size=_chunk_bytes(header),
            compression=CompressionType.NONE,
            enable_data_crcs=True,
        )
        self._mcap.start(profile="", library="driverview")
        self._channels = self._register()
        self.add_metadata(ROUND_METADATA, header.to_metadata())

    def add(self, topic: str, log_time: int, step: int, data: bytes | memoryview) -> None:
        """Append the serialised message `data` of frame `step` to `topic`; `log_time` is in ns."""
        channel = self._channels[topic]
        self._mcap.add_message(channel, log_time, bytes(data), publish_time=log_time, sequence=step)

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Append a metadata record."""
        self._mcap.add_metadata(name, values)

    def finish(self) -> None:
        """Write the index and close the file."""
        self._mcap.finish()  # type: ignore[no-untyped-call]  # mcap leaves it untyped
        self._stream.close()

    def close(self) -> None:
        """Close the file without writing its index."""
        self._stream.close()

    def __enter__(self) -> "RoundFile":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _register(self) -> dict[str, int]:
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for topic, message_type in topics.MESSAGE_TYPES.items():
            name = message_type.DESCRIPTOR.full_name
            if name not in schemas:
                schemas[name] = self._mcap.register_schema(
                    name, SchemaEncoding.Protobuf, topics.schema_data(message_type)
                )
            channels[topic] = self._mcap.register_channel(
                topic, MessageEncoding.Protobuf, schemas[name]
            )
        return channels


def _chunk_bytes(header: RoundHeader) -> int:
    """Return the size (bytes) of a chunk, about one second of messages. The size determines the
    recorded bytes, so never change this function."""
    pixels = header.camera.width * header.camera.height
    step = pixels * BYTES_PER_PIXEL[header.codec] + OTHER_BYTES
    return int(step * header.frequency_hz)
