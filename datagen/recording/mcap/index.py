"""Opens a round: gives random access to the messages of its MCAP file.

An uncompressed, indexed file is memory-mapped, and a message index is read as an array on first
use. Any other file is read with the official reader, message by message. Both ways give the same
`RoundIndex`, and both check the CRC of a chunk before one of its messages is used.
"""

import errno
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from numpy.typing import NDArray

from datagen.recording.errors import MAKE_AGAIN, DatasetError
from datagen.recording.mcap.footer import Summary, read_metadata, read_summary
from datagen.recording.mcap.mmap import map_file
from datagen.recording.mcap.records import (
    CHUNK,
    CHUNK_HEAD,
    LONG_LENGTH,
    MESSAGE,
    MESSAGE_FIELDS,
    MESSAGE_INDEX,
    RECORD,
)
from datagen.recording.round_metadata import (
    RECOVERY_METADATA,
    RESULT_METADATA,
    ROUND_METADATA,
    Recovery,
    RoundHeader,
    RoundResult,
)
from datagen.recording.schema import topics

# Exceptions that the official reader and this module raise for bytes that are not an MCAP file;
# MemoryError is the result of a damaged length.
DAMAGE_ERRORS = (
    McapError, ValueError, KeyError, TypeError, IndexError, OverflowError, struct.error,
    MemoryError,
)  # fmt: skip
LABEL_READER_TOPICS = (topics.CAMERA, topics.LABELS, topics.EGO_STATE)


class Messages(Protocol):
    """The messages of one topic, in file order."""

    def __len__(self) -> int: ...

    @property
    def log_time(self) -> NDArray[np.int64]:
        """Log times (N,) in ns: simulated time plus `topics.EPOCH_NS`."""

    def payload(self, i: int) -> memoryview:
        """Return the bytes of the serialised message number `i` (from 0).

        Raises ValueError if its chunk is damaged, or the index does not point to a message.
        """


class CheckedChunks:
    """Checks the chunks of a memory-mapped file by their CRC, each undamaged chunk only once.

    A CRC of 0 means that the writer computed none (mcap.dev/spec): then only sizes are checked.
    """

    def __init__(self, view: memoryview, summary: Summary) -> None:
        self._view, self._chunks = view, summary.chunks
        self._is_good = bytearray(len(summary.chunks))

    def require(self, number: int) -> None:
        """Raise ValueError if chunk `number` is damaged."""
        if self._is_good[number]:
            return
        start = self._chunks[number].start
        if not _chunk_is_good(self._view, start):
            raise ValueError(f"the chunk at byte {start} is damaged (its CRC)")
        self._is_good[number] = 1


def _chunk_is_good(view: memoryview, start: int) -> bool:
    """Whether sizes and CRC in the uncompressed chunk at byte `start` fit its messages."""
    if start + CHUNK_HEAD > len(view):
        return False
    opcode, length = RECORD.unpack_from(view, start)
    _, _, size, crc, name_length = CHUNK.unpack_from(view, start + RECORD.size)
    (inner,) = LONG_LENGTH.unpack_from(view, start + RECORD.size + CHUNK.size)
    messages = view[start + CHUNK_HEAD : start + CHUNK_HEAD + size]
    if (opcode, name_length, inner, len(messages)) != (Opcode.CHUNK, 0, size, size):
        return False
    return length == CHUNK_HEAD - RECORD.size + size and (not crc or zlib.crc32(messages) == crc)


@dataclass(frozen=True)
class MappedMessages:
    """Messages of one channel of a memory-mapped file; their index is read on first use."""

    view: memoryview
    summary: Summary
    channel: int
    chunks: CheckedChunks

    def __len__(self) -> int:
        count = self.summary.counts.get(self.channel)
        return len(self.log_time) if count is None else count

    @property
    def log_time(self) -> NDArray[np.int64]:
        return self._table[0]

    def payload(self, i: int) -> memoryview:
        times, places, chunks = self._table
        self.chunks.require(int(chunks[i]))
        start = int(places[i])
        opcode, length, channel, _, log_time, _ = self._unpack(MESSAGE, start)
        if (opcode, channel, log_time) != (Opcode.MESSAGE, self.channel, times[i]):
            raise ValueError("a message index points at something else")
        end = start + RECORD.size + length
        if length < MESSAGE_FIELDS or end > len(self.view):
            raise ValueError("a message reaches beyond the end of the file")
        return self.view[start + MESSAGE.size : end]

    @cached_property
    def _table(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Return the log times (N,) in ns, file offsets (N,) and chunk numbers (N,) of the
        messages, from the message index that follows each chunk."""
        parts, starts, numbers, sizes = [], [], [], []
        for number, chunk in enumerate(self.summary.chunks):
            at = chunk.indexes.get(self.channel)
            if at is not None:
                parts.append(self._entries(at))
                starts.append(chunk.start + CHUNK_HEAD)
                numbers.append(number)
                sizes.append(len(parts[-1]))
        if not parts:
            return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64)
        entries = np.concatenate(parts)
        if len(entries) != self.summary.counts.get(self.channel, len(entries)):
            raise ValueError(
                f"{len(entries)} messages are indexed, but the summary counts another number"
            )
        offsets = entries[:, 1] + np.repeat(np.array(starts, np.int64), sizes)
        return entries[:, 0], offsets, np.repeat(np.array(numbers, np.int64), sizes)

    def _entries(self, at: int) -> NDArray[np.int64]:
        opcode, _ = self._unpack(RECORD, at)
        channel, size = self._unpack(MESSAGE_INDEX, at + RECORD.size)
        if (opcode, channel) != (Opcode.MESSAGE_INDEX, self.channel):
            raise ValueError("there is no message index where the summary points")
        start = at + RECORD.size + MESSAGE_INDEX.size
        entries: NDArray[np.int64] = np.frombuffer(self.view, "<i8", size // 8, start)
        return entries.reshape(-1, 2)

    def _unpack(self, layout: struct.Struct, at: int) -> tuple[int, ...]:
        try:
            return layout.unpack_from(self.view, at)
        except struct.error as error:
            raise ValueError("an index points outside the file") from error


@dataclass(frozen=True)
class LoadedMessages:
    """Messages of one topic in memory, for a file that is compressed or has no index."""

    log_time: NDArray[np.int64]
    payloads: Sequence[bytes]

    def __len__(self) -> int:
        return len(self.payloads)

    def payload(self, i: int) -> memoryview:
        return memoryview(self.payloads[i])


@dataclass(frozen=True)
class RoundIndex:
    """An opened round: its metadata, and its messages by topic.

    `messages` has only the topics for which the round was opened.
    """

    path: Path
    header: RoundHeader
    result: RoundResult
    messages: dict[str, Messages]
    summary: Summary | None
    """Summary section of the file; None if the official reader was used."""
    recovery: Recovery | None = None
    """Recovery record of a round that was recovered from a damaged file and lacks frames."""

    def log_times(self, topic: str) -> NDArray[np.int64]:
        """Return the log times (N,) in ns of the messages of an opened topic. Raises DatasetError
        if the message index of the topic is damaged."""
        try:
            return self.messages[topic].log_time
        except ValueError as error:
            raise DatasetError(
                f"{self.path}: the message index of {topic} is damaged ({error}); run `datagen "
                "verify` on the dataset, and record the round again or save its undamaged frames "
                "with `datagen recover`"
            ) from error


def open_round(path: Path, topic_names: Sequence[str] = LABEL_READER_TOPICS) -> RoundIndex:
    """Open a recorded round for reading the topics `topic_names`. Raises DatasetError if the file
    is damaged or of another format."""
    try:
        return _map_round(path, topic_names) or _load_round(path, topic_names)
    except _NotARoundError as error:
        raise DatasetError(
            f"{path} is an MCAP file but no round of driverview ({error}); move it elsewhere"
        ) from error
    except _OtherVersionError as error:
        raise DatasetError(
            f"{path} was written by another version of this program ({error}); record it again "
            "with this one, or use the program it came from"
        ) from error
    except (*DAMAGE_ERRORS, OSError) as error:
        # A damaged offset gives EINVAL; other OSErrors are not the fault of the file.
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            raise
        raise DatasetError(
            f"{path} is damaged or not a recorded round ({error or type(error).__name__}); delete "
            f"it and {MAKE_AGAIN}, or save its undamaged frames with `datagen recover`"
        ) from error


class _NotARoundError(ValueError):
    """An undamaged MCAP file that is not a round of this program."""


class _OtherVersionError(ValueError):
    """A round written by another version of this program."""


def _map_round(path: Path, topic_names: Sequence[str]) -> RoundIndex | None:
    """Memory-map the round and index the messages of the topics `topic_names`. Return None if the
    file is compressed or has no message index."""
    view = map_file(path)
    summary = read_summary(view)
    if not summary.chunks or any(c.compression or not c.indexes for c in summary.chunks):
        return None
    metadata = {n: read_metadata(view, place) for n, place in summary.metadata.items()}
    header, result, recovery = _parse_metadata(metadata)
    chunks = CheckedChunks(view, summary)
    found: dict[str, Messages] = {
        topic: MappedMessages(view, summary, _channel(summary, topic), chunks)
        for topic in topic_names
    }
    return RoundIndex(path, header, result, found, summary, recovery)


def _channel(summary: Summary, topic: str) -> int:
    if topic not in summary.channels:
        raise ValueError(f"no channel has the topic {topic}")
    return summary.channels[topic]


def _parse_metadata(
    metadata: dict[str, dict[str, str]],
) -> tuple[RoundHeader, RoundResult, Recovery | None]:
    for name in (ROUND_METADATA, RESULT_METADATA):
        if name not in metadata:
            raise _NotARoundError(f"it has no metadata {name}")
    recovered = metadata.get(RECOVERY_METADATA)
    try:
        header = RoundHeader.from_metadata(metadata[ROUND_METADATA])
        result = RoundResult.from_metadata(metadata[RESULT_METADATA])
        recovery = None if recovered is None else Recovery.from_metadata(recovered)
    except (KeyError, TypeError) as error:
        program = metadata[ROUND_METADATA].get("program", "an unknown program")
        raise _OtherVersionError(f"{program}; {type(error).__name__}: {error}") from error
    header.validate()
    return header, result, recovery


def _load_round(path: Path, topic_names: Sequence[str]) -> RoundIndex:
    times: dict[str, list[int]] = {topic: [] for topic in topic_names}
    payloads: dict[str, list[bytes]] = {topic: [] for topic in topic_names}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        header, result, recovery = _parse_metadata(metadata)
        for _, channel, message in reader.iter_messages(topic_names, log_time_order=False):
            times[channel.topic].append(message.log_time)
            payloads[channel.topic].append(message.data)
    found: dict[str, Messages] = {
        t: LoadedMessages(np.array(times[t], dtype=np.int64), payloads[t]) for t in topic_names
    }
    return RoundIndex(path, header, result, found, None, recovery)
