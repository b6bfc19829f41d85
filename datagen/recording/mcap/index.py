"""Where the messages of a round lie in its file, found without walking through it.

An uncompressed, indexed MCAP file is memory-mapped and its message indexes are read as arrays when
they are first asked for; any other goes through the official reader, message by message. Both give
the same `RoundIndex`.
"""

import errno
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from numpy.typing import NDArray

from datagen.recording.errors import DatasetError
from datagen.recording.mcap.footer import Summary, read_metadata, read_summary
from datagen.recording.mcap.mmap import map_file
from datagen.recording.mcap.records import (
    CHUNK_HEAD,
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

# What the official reader and our own raise on bytes that are no MCAP file; the last one when a
# damaged length asks for more than there is.
DAMAGE = (
    McapError, ValueError, KeyError, TypeError, IndexError, OverflowError, struct.error,
    MemoryError,
)  # fmt: skip
READ_TOPICS = (topics.CAMERA, topics.LABELS, topics.EGO_STATE)


class Messages(Protocol):
    """The messages of one topic, in file order."""

    def __len__(self) -> int: ...

    @property
    def log_time(self) -> NDArray[np.int64]:
        """(N,) ns since 1970, simulated time from `topics.EPOCH_NS`."""

    def payload(self, i: int) -> memoryview:
        """The serialised message; ValueError when it is not where the index places it."""


@dataclass(frozen=True)
class MappedMessages:
    """Messages in a memory-mapped file; only the places that are asked for are read."""

    view: memoryview
    summary: Summary
    channel: int

    def __len__(self) -> int:
        count = self.summary.counts.get(self.channel)
        return len(self.log_time) if count is None else count

    @property
    def log_time(self) -> NDArray[np.int64]:
        return self._table[0]

    def payload(self, i: int) -> memoryview:
        times, places = self._table
        start = int(places[i])
        opcode, length, channel, _, log_time, _ = self._read(MESSAGE, start)
        if (opcode, channel, log_time) != (Opcode.MESSAGE, self.channel, times[i]):
            raise ValueError("a message index points at something else")
        end = start + RECORD.size + length
        if length < MESSAGE_FIELDS or end > len(self.view):
            raise ValueError("a message reaches beyond the end of the file")
        return self.view[start + MESSAGE.size : end]

    @cached_property
    def _table(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Log times and places in the file, read from the message index after each chunk."""
        parts, starts, sizes = [], [], []
        for chunk in self.summary.chunks:
            at = chunk.indexes.get(self.channel)
            if at is not None:
                parts.append(self._entries(at))
                starts.append(chunk.start + CHUNK_HEAD)
                sizes.append(len(parts[-1]))
        if not parts:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        entries = np.concatenate(parts)
        if len(entries) != self.summary.counts.get(self.channel, len(entries)):
            raise ValueError(f"{len(entries)} messages are indexed, more or fewer were counted")
        return entries[:, 0], entries[:, 1] + np.repeat(np.array(starts, np.int64), sizes)

    def _entries(self, at: int) -> NDArray[np.int64]:
        opcode, _ = self._read(RECORD, at)
        channel, size = self._read(MESSAGE_INDEX, at + RECORD.size)
        if (opcode, channel) != (Opcode.MESSAGE_INDEX, self.channel):
            raise ValueError("there is no message index where the file's index places it")
        start = at + RECORD.size + MESSAGE_INDEX.size
        entries: NDArray[np.int64] = np.frombuffer(self.view, "<i8", size // 8, start)
        return entries.reshape(-1, 2)

    def _read(self, what: struct.Struct, at: int) -> tuple[int, ...]:
        try:
            return what.unpack_from(self.view, at)
        except struct.error as error:
            raise ValueError("an index points outside the file") from error


@dataclass(frozen=True)
class LoadedMessages:
    """Messages held in memory, for files that cannot be mapped."""

    log_time: NDArray[np.int64]
    payloads: Sequence[bytes]

    def __len__(self) -> int:
        return len(self.payloads)

    def payload(self, i: int) -> memoryview:
        return memoryview(self.payloads[i])


@dataclass(frozen=True)
class RoundIndex:
    """An opened round: what it says about itself, and the messages that a reader of labels needs.

    `messages` has the topics it was opened for: `READ_TOPICS`, unless others were asked for.
    """

    path: Path
    header: RoundHeader
    result: RoundResult
    messages: dict[str, Messages]
    summary: Summary | None
    """Absent when the official reader had to read the file."""
    recovery: Recovery | None = None
    """Present when the round was saved from a damaged file: frames of it are missing."""

    @property
    def mapped(self) -> bool:
        return self.summary is not None


def open_round(path: Path, wanted: Sequence[str] = READ_TOPICS) -> RoundIndex:
    """Index topics of a recorded round; DatasetError when it is damaged or not one of ours."""
    return _guarded(path, lambda: _map_round(path, wanted) or _load_round(path, wanted))


def load_round(path: Path, wanted: Sequence[str] = READ_TOPICS) -> RoundIndex:
    """The same through the official reader: slow, for any kind of MCAP file, and the oracle."""
    return _guarded(path, lambda: _load_round(path, wanted))


class _ForeignError(ValueError):
    """A whole MCAP file that is none of ours."""


class _VersionError(ValueError):
    """A round that another version of this program has written."""


def _guarded(path: Path, read: Callable[[], RoundIndex]) -> RoundIndex:
    try:
        return read()
    except _ForeignError as error:
        raise DatasetError(
            f"{path} is an MCAP file but no round of driverview ({error}); move it elsewhere"
        ) from error
    except _VersionError as error:
        raise DatasetError(
            f"{path} was written by another version of this program ({error}); record it again "
            "with this one, or use the program it came from"
        ) from error
    except (*DAMAGE, OSError) as error:
        # A damaged offset is an invalid argument to the system; other errors are not the file's.
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            raise
        raise DatasetError(
            f"{path} is damaged or not a recorded round ({error or type(error).__name__}); delete "
            "it and run the same `datagen collect` again, or save its whole frames with "
            "`datagen recover`"
        ) from error


def _map_round(path: Path, wanted: Sequence[str]) -> RoundIndex | None:
    """None when the file is compressed or has no message index."""
    view = map_file(path)
    summary = read_summary(view)
    if not summary.chunks or any(c.compression or not c.indexes for c in summary.chunks):
        return None
    metadata = {n: read_metadata(view, place) for n, place in summary.metadata.items()}
    header, result, recovery = _describe(metadata)
    found: dict[str, Messages] = {
        topic: MappedMessages(view, summary, _channel(summary, topic)) for topic in wanted
    }
    return RoundIndex(path, header, result, found, summary, recovery)


def _channel(summary: Summary, topic: str) -> int:
    if topic not in summary.channels:
        raise ValueError(f"no channel has the topic {topic}")
    return summary.channels[topic]


def _describe(
    metadata: dict[str, dict[str, str]],
) -> tuple[RoundHeader, RoundResult, Recovery | None]:
    for name in (ROUND_METADATA, RESULT_METADATA):
        if name not in metadata:
            raise _ForeignError(f"it has no metadata {name}")
    noted = metadata.get(RECOVERY_METADATA)
    try:
        header = RoundHeader.from_metadata(metadata[ROUND_METADATA])
        result = RoundResult.from_metadata(metadata[RESULT_METADATA])
        recovery = None if noted is None else Recovery.from_metadata(noted)
    except (KeyError, TypeError) as error:
        program = metadata[ROUND_METADATA].get("program", "an unknown program")
        raise _VersionError(f"{program}; {type(error).__name__}: {error}") from error
    header.require_sane()
    return header, result, recovery


def _load_round(path: Path, wanted: Sequence[str]) -> RoundIndex:
    times: dict[str, list[int]] = {topic: [] for topic in wanted}
    payloads: dict[str, list[bytes]] = {topic: [] for topic in wanted}
    with path.open("rb") as stream:
        reader = make_reader(stream)
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        header, result, recovery = _describe(metadata)
        for _, channel, message in reader.iter_messages(wanted, log_time_order=False):
            times[channel.topic].append(message.log_time)
            payloads[channel.topic].append(message.data)
    found: dict[str, Messages] = {
        t: LoadedMessages(np.array(times[t], dtype=np.int64), payloads[t]) for t in wanted
    }
    return RoundIndex(path, header, result, found, None, recovery)
