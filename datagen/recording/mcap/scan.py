"""Checks a whole MCAP file in one pass: SHA-256, CRCs, and the index of every message.

Only one chunk is in memory at a time. Source of the CRCs: mcap.dev/spec (Chunk, DataEnd, Footer);
a CRC of zero means that it was not computed.
"""

import hashlib
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BufferedIOBase, BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.stream_reader import get_chunk_data_stream

from datagen.recording.mcap.footer import ChunkIndex
from datagen.recording.mcap.index import DAMAGE_ERRORS
from datagen.recording.mcap.records import (
    CHUNK,
    CHUNK_HEAD,
    CRC_BYTES,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    RECORD,
)
from datagen.recording.mcap.records import text as read_text
from datagen.recording.schema.topics import seconds

OnMessage = Callable[[str, int, memoryview], None]
"""Called for every message with its topic, log time (ns) and payload."""
READ_BYTES = 1 << 20
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


@dataclass
class Scan:
    """Result of a scan. `times` are the log times (ns) of the messages by topic, in file order."""

    sha256: str = ""
    size: int = 0
    times: dict[str, list[int]] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def scan(path: Path, on_message: OnMessage) -> Scan:
    """Read the file at `path` once and check it; `problems` of the result lists its damage.
    `on_message` is called with the topic, log time (ns) and payload of each message. Raises OSError
    if the file cannot be read."""
    with path.open("rb") as stream:
        return _Scanner(stream, path.stat().st_size, on_message).run()


class _Scanner:
    def __init__(self, stream: BufferedIOBase, size: int, on_message: OnMessage) -> None:
        self._stream = stream
        self._size = size
        self._on_message = on_message
        self._digest = hashlib.sha256()
        self._at = 0
        self._crc = 0  # CRC of the current section up to now
        self._topics: dict[int, str] = {}  # by channel
        self._entries: dict[
            int, list[int]
        ] = {}  # log times and offsets of the last chunk's messages, by channel
        self._found = Scan(size=size)

    def run(self) -> Scan:
        found = self._found
        try:
            self._read_all()
        except DAMAGE_ERRORS as error:
            found.problems.append(f"cannot be read to its end: {error or type(error).__name__}")
        while block := self._stream.read(READ_BYTES):
            self._digest.update(block)
        found.sha256 = self._digest.hexdigest()
        return found

    def _read_all(self) -> None:
        if self._read(len(MAGIC)) != MAGIC:
            raise ValueError("it does not start with the MCAP magic")
        opcode = 0
        summary_at = 0
        while opcode != Opcode.FOOTER:
            start, before = self._at, self._crc
            opcode, body = self._read_record()
            if opcode == Opcode.CHUNK:
                self._end_chunk()
                self._chunk(start, memoryview(body))
            elif opcode == Opcode.MESSAGE_INDEX:
                self._message_index(start, memoryview(body))
            elif opcode == Opcode.MESSAGE:
                self._message(memoryview(body), -RECORD.size, len(body))
            elif opcode == Opcode.CHANNEL:
                self._channel(memoryview(body), 0)
            elif opcode == Opcode.DATA_END:
                self._end_chunk()
                self._check_crc(before, body, "its data section is damaged (the section's CRC)")
                self._crc, summary_at = 0, self._at
        if not summary_at:
            self._found.problems.append("its data section has no end")
        self._footer(before, body, summary_at)
        if (rest := self._read(self._size - self._at)) != MAGIC:
            raise ValueError(f"{len(rest)} bytes follow where the MCAP magic ends a file")

    def _read_record(self) -> tuple[int, bytes]:
        head = self._read(RECORD.size)
        opcode, length = RECORD.unpack(head)
        if length > self._size - self._at:
            raise ValueError(f"a record at byte {self._at - RECORD.size} reaches beyond the end")
        return opcode, self._read(length)

    def _read(self, count: int) -> bytes:
        data = self._stream.read(count)
        self._digest.update(data)
        self._crc = zlib.crc32(data, self._crc)
        self._at += len(data)
        if len(data) < count:
            raise ValueError("its end is missing")
        return data

    def _chunk(self, start: int, body: memoryview) -> None:
        first, _, _, crc, name_length = CHUNK.unpack_from(body)
        data = body[CHUNK_HEAD - RECORD.size :]
        compression = ""
        if name_length:
            compression, _ = read_text(body, CHUNK.size - 4)
            data = decompressed(body)
        if crc and zlib.crc32(data) != crc:
            self._found.problems.append(f"damaged near {seconds(first):.2f} s (a chunk's CRC)")
        self._found.chunks.append(ChunkIndex(start, compression, {}))
        at, end = 0, len(data)
        while at < end:
            opcode, length = RECORD.unpack_from(data, at)
            after = at + RECORD.size + length
            if after > end:
                raise ValueError("a message reaches beyond its chunk")
            if opcode == Opcode.MESSAGE:
                self._message(data, at, after)
            elif opcode == Opcode.CHANNEL:
                self._channel(data, at + RECORD.size)
            at = after

    def _channel(self, data: memoryview, at: int) -> None:
        self._topics[int.from_bytes(data[at : at + 2], "little")] = read_text(data, at + 4)[0]

    def _message(self, data: memoryview, at: int, after: int) -> None:
        channel, _, time, _ = MESSAGE_HEAD.unpack_from(data, at + RECORD.size)
        self._entries.setdefault(channel, []).extend((time, at))
        topic = self._topics[channel]
        self._found.times.setdefault(topic, []).append(time)
        self._on_message(topic, time, data[at + MESSAGE.size : after])

    def _message_index(self, start: int, body: memoryview) -> None:
        channel, _ = MESSAGE_INDEX.unpack_from(body)
        if self._found.chunks:
            self._found.chunks[-1].indexes[channel] = start
        entries = self._entries.pop(channel, [])
        head = MESSAGE_INDEX.pack(channel, 8 * len(entries))
        if body != head + struct.pack(f"<{len(entries)}Q", *entries):
            self._found.problems.append(f"a message index at byte {start} does not match its chunk")

    def _end_chunk(self) -> None:
        """Add a problem if channels of the last chunk have no message index, although at least one
        chunk read so far has message indexes."""
        chunks = self._found.chunks
        if self._entries and chunks and any(chunk.indexes for chunk in chunks):
            self._found.problems.append(f"no message index for channels {sorted(self._entries)}")
        self._entries = {}

    def _footer(self, before: int, body: bytes, summary_at: int) -> None:
        start, offsets, _ = struct.unpack("<QQI", body)
        if start not in (0, summary_at):
            self._found.problems.append("its footer has no position of the index")
        head = FOOTER.pack(Opcode.FOOTER, len(body), start, offsets, 0)[:-CRC_BYTES]
        self._check_crc(
            zlib.crc32(head, before), body[-CRC_BYTES:], "its index is damaged (its CRC)"
        )

    def _check_crc(self, crc: int, stored: bytes, problem: str) -> None:
        expected = int.from_bytes(stored, "little")
        if len(stored) != CRC_BYTES or (expected and expected != crc):
            self._found.problems.append(problem)


def decompressed(body: memoryview) -> memoryview:
    """Decompress the messages of a chunk; `body` is the content of its record. Raises the errors of
    the official library."""
    stream, length = get_chunk_data_stream(Chunk.read(ReadDataStream(BytesIO(body))))
    return memoryview(stream.read(length))
