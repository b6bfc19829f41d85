"""Where the messages of a round lie in its file, found without walking through it.

An uncompressed, indexed MCAP file is memory-mapped and its message indexes are read as arrays;
any other goes through the official reader, message by message. Both give the same `RoundIndex`.
"""

import errno
import io
import mmap
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, ChunkIndex, Footer, Metadata, MetadataIndex
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from . import topics
from .errors import DatasetError
from .header import RESULT_METADATA, ROUND_METADATA, RoundHeader, RoundResult

MAGIC = b"\x89MCAP0\r\n"
FOOTER_BYTES = 9 + 20 + len(MAGIC)
RECORD_HEAD = 9  # opcode and length
MESSAGE_HEAD = 22  # channel, sequence, log time, publish time
CHUNK_HEAD = RECORD_HEAD + 40  # of an uncompressed chunk, up to its records
INDEX_HEAD = RECORD_HEAD + 6  # channel and byte count, before the entries
# What the official reader and our own raise on bytes that are no MCAP file; the last one when a
# damaged length asks for more than there is.
DAMAGE = (
    McapError, ValueError, KeyError, TypeError, IndexError, OverflowError, struct.error,
    MemoryError,
)  # fmt: skip
READ_TOPICS = (topics.CAMERA, topics.LABELS, topics.EGO_STATE)


class Messages(Protocol):
    """The messages of one topic, in file order."""

    @property
    def log_time(self) -> NDArray[np.int64]: ...

    def payload(self, i: int) -> memoryview: ...


@dataclass(frozen=True)
class MappedMessages:
    """Messages in a memory-mapped file: byte positions and lengths of their payloads."""

    log_time: NDArray[np.int64]
    start: NDArray[np.int64]
    length: NDArray[np.int64]
    view: memoryview

    def payload(self, i: int) -> memoryview:
        start = int(self.start[i])
        return self.view[start : start + int(self.length[i])]


@dataclass(frozen=True)
class LoadedMessages:
    """Messages held in memory, for files that cannot be mapped."""

    log_time: NDArray[np.int64]
    payloads: Sequence[bytes]

    def payload(self, i: int) -> memoryview:
        return memoryview(self.payloads[i])


@dataclass(frozen=True)
class RoundIndex:
    path: Path
    header: RoundHeader
    result: RoundResult
    messages: dict[str, Messages]
    mapped: bool


def open_round(path: Path) -> RoundIndex:
    """Index a recorded round; DatasetError when it is damaged or not one of ours."""
    return _guarded(path, lambda: _map_round(path) or _load_round(path))


def load_round(path: Path) -> RoundIndex:
    """The same through the official reader: slow, for any kind of MCAP file, and the oracle."""
    return _guarded(path, lambda: _load_round(path))


def _guarded(path: Path, read: Callable[[], RoundIndex]) -> RoundIndex:
    try:
        return read()
    except (*DAMAGE, OSError) as error:
        # A damaged offset is an invalid argument to the system; other errors are not the file's.
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            raise
        raise DatasetError(
            f"{path} is damaged or not a recorded round ({error}); delete it and run the same "
            "`datagen collect` again"
        ) from error


def _map_round(path: Path) -> RoundIndex | None:
    """None when the file is compressed or has no message index."""
    size = path.stat().st_size
    if size < len(MAGIC) + FOOTER_BYTES:
        raise ValueError(f"{size} bytes are too few for an MCAP file")
    with path.open("rb") as stream:
        view = memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
    if view[: len(MAGIC)] != MAGIC:
        raise ValueError("it does not start with the MCAP magic")
    if view[-len(MAGIC) :] != MAGIC:
        raise ValueError("its end is missing (it does not end with the MCAP magic)")
    channels, chunks, metadata = _read_summary(view)
    if not chunks or any(c.compression or not c.message_index_offsets for c in chunks):
        return None
    header, result = _describe(lambda name: _metadata_at(view, metadata[name]))
    ids = {channel.topic: channel.id for channel in channels}
    found: dict[str, Messages] = {t: _map_topic(view, chunks, ids[t]) for t in READ_TOPICS}
    return RoundIndex(path, header, result, found, mapped=True)


def _read_summary(
    view: memoryview,
) -> tuple[list[Channel], list[ChunkIndex], dict[str, MetadataIndex]]:
    (start,) = struct.unpack_from("<Q", view, len(view) - FOOTER_BYTES + RECORD_HEAD)
    channels: list[Channel] = []
    chunks: list[ChunkIndex] = []
    metadata: dict[str, MetadataIndex] = {}
    if not 0 < start < len(view):
        return channels, chunks, metadata
    for record in StreamReader(io.BytesIO(view[start:]), skip_magic=True).records:
        if isinstance(record, Channel):
            channels.append(record)
        elif isinstance(record, ChunkIndex):
            chunks.append(record)
        elif isinstance(record, MetadataIndex):
            metadata[record.name] = record
        elif isinstance(record, Footer):
            break
    return channels, chunks, metadata


def _metadata_at(view: memoryview, index: MetadataIndex) -> dict[str, str]:
    data = io.BytesIO(view[index.offset : index.offset + index.length])
    record = next(StreamReader(data, skip_magic=True).records)
    if not isinstance(record, Metadata):
        raise ValueError(f"no metadata {index.name!r} where the index places it")
    return record.metadata


def _describe(metadata: Callable[[str], dict[str, str]]) -> tuple[RoundHeader, RoundResult]:
    return (
        RoundHeader.from_metadata(metadata(ROUND_METADATA)),
        RoundResult.from_metadata(metadata(RESULT_METADATA)),
    )


def _map_topic(view: memoryview, chunks: list[ChunkIndex], channel: int) -> MappedMessages:
    times, places = [], []
    for chunk in chunks:
        offset = chunk.message_index_offsets.get(channel)
        if offset is None:
            continue
        (count,) = struct.unpack_from("<I", view, offset + RECORD_HEAD + 2)
        entries = np.frombuffer(view, "<i8", count // 8, offset + INDEX_HEAD).reshape(-1, 2)
        times.append(entries[:, 0])
        places.append(entries[:, 1] + chunk.chunk_start_offset + CHUNK_HEAD)
    if not times:
        raise ValueError(f"no messages on channel {channel}")
    record = np.concatenate(places)
    length = _record_lengths(view, record, channel)
    start = record + RECORD_HEAD + MESSAGE_HEAD
    return MappedMessages(np.concatenate(times), start, length - MESSAGE_HEAD, view)


def _record_lengths(view: memoryview, record: NDArray[np.int64], channel: int) -> NDArray[np.int64]:
    """Lengths of the message records at these positions, each proved to be one of `channel`."""
    data = np.frombuffer(view, np.uint8)
    if record.min() < 0 or record.max() + RECORD_HEAD + MESSAGE_HEAD > data.size:
        raise ValueError("a message index points outside the file")
    head = data[record[:, None] + np.arange(RECORD_HEAD + 2)]
    length = np.ascontiguousarray(head[:, 1:9]).view("<i8")[:, 0]
    owner = np.ascontiguousarray(head[:, 9:11]).view("<u2")[:, 0]
    if (head[:, 0] != Opcode.MESSAGE).any() or (owner != channel).any():
        raise ValueError("a message index points at something else")
    if length.min() < MESSAGE_HEAD or (record + RECORD_HEAD + length).max() > data.size:
        raise ValueError("a message reaches beyond the end of the file")
    return length


def _load_round(path: Path) -> RoundIndex:
    times: dict[str, list[int]] = {topic: [] for topic in READ_TOPICS}
    payloads: dict[str, list[bytes]] = {topic: [] for topic in READ_TOPICS}
    with path.open("rb") as stream:
        reader = make_reader(stream)
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        for _, channel, message in reader.iter_messages(READ_TOPICS, log_time_order=False):
            times[channel.topic].append(message.log_time)
            payloads[channel.topic].append(message.data)
    header, result = _describe(metadata.__getitem__)
    found: dict[str, Messages] = {
        t: LoadedMessages(np.array(times[t], dtype=np.int64), payloads[t]) for t in READ_TOPICS
    }
    return RoundIndex(path, header, result, found, mapped=False)
