"""The MCAP file of a round as it is written: our topics, our chunks, fixed order, fixed bytes."""

from pathlib import Path
from types import TracebackType

from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer

from . import topics
from .header import ROUND_METADATA, RoundHeader

# Bytes a pixel that the codecs need on our images, and what the other topics need a step.
BYTES_PER_PIXEL = {"jpeg": 0.5, "png": 1.8}
OTHER_BYTES = 6_000


class RoundFile:
    """Serialised messages in, one at a time; `finish` closes the file. A context manager."""

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
        """Append one message of control step `step`."""
        channel = self._channels[topic]
        self._mcap.add_message(channel, log_time, bytes(data), publish_time=log_time, sequence=step)

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        self._mcap.add_metadata(name, values)

    def finish(self) -> None:
        """Write the index and close the file."""
        self._mcap.finish()  # type: ignore[no-untyped-call]  # mcap leaves it untyped
        self._stream.close()

    def __enter__(self) -> "RoundFile":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stream.close()

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
    """About one second of messages."""
    pixels = header.camera.width * header.camera.height
    step = pixels * BYTES_PER_PIXEL[header.codec] + OTHER_BYTES
    return int(step * header.frequency_hz)
