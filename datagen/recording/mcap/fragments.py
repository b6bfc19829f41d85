"""Finds the undamaged chunks and messages of a damaged MCAP file, without its index.

A chunk record holds its size three times, and a CRC. If two of the sizes agree and the CRC is
right, the chunk is undamaged. Source: mcap.dev/spec (Chunk).
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

from mcap.opcode import Opcode

from datagen.recording.mcap.records import (
    CHUNK,
    CHUNK_HEAD,
    LENGTH,
    LONG_LENGTH,
    MESSAGE,
    RECORD,
    text_map,
)
from datagen.recording.mcap.records import text as read_text
from datagen.recording.schema import topics

CHUNK_OPCODE = bytes([Opcode.CHUNK])
MAX_DURATION_NS = 366 * 86_400 * topics.NANOSECONDS


@dataclass(frozen=True, slots=True)
class ChunkBytes:
    """Bytes of the messages of a chunk. If `intact` is true, the CRC is right. Otherwise the end of
    the chunk is cut or overwritten."""

    data: memoryview
    intact: bool


@dataclass(frozen=True, slots=True)
class FoundMessage:
    """A message found in a chunk. `step`, its sequence number, is the number of its frame;
    `log_time` is in ns."""

    topic: str
    step: int
    log_time: int
    payload: memoryview


def find_chunks(data: bytes) -> Iterator[ChunkBytes]:
    """Yield all undamaged chunks and, after the last of them, the start of a chunk that is cut off.

    A chunk with a wrong CRC that is followed by another chunk or by its index is left out, because
    any of its bytes can be wrong.
    """
    view = memoryview(data)
    at, torn = 0, None
    while (at := data.find(CHUNK_OPCODE, at)) >= 0:
        size, crc = _chunk_size_and_crc(view, at)
        messages = view[at + CHUNK_HEAD : at + CHUNK_HEAD + size]
        if size and len(messages) == size and zlib.crc32(messages) == crc:
            yield ChunkBytes(messages, intact=True)
            at, torn = at + CHUNK_HEAD + size, None
            continue
        if size and torn is None and not _has_message_index(view, at + CHUNK_HEAD + size):
            torn = ChunkBytes(messages, intact=False)
        at += 1
    if torn is not None:
        yield torn


def chunk_messages(chunk: ChunkBytes) -> Iterator[FoundMessage]:
    """Yield the messages of a chunk in file order; for a cut chunk, only messages that are
    certainly complete."""
    found, cut = _parse_messages(chunk.data)
    # If other bytes follow the messages, they may have overwritten the end of the last one.
    yield from found if chunk.intact or cut else found[:-1]


def find_metadata(data: bytes, name: str) -> dict[str, str] | None:
    """Find the metadata record called `name` anywhere in `data`; None if it is missing or cut."""
    at = data.find(LENGTH.pack(len(name)) + name.encode())
    if at < 0:
        return None
    view = memoryview(data)
    try:
        return text_map(view, read_text(view, at)[1])
    except (ValueError, struct.error):
        return None


def _chunk_size_and_crc(view: memoryview, at: int) -> tuple[int, int]:
    """Return the size (bytes) and the CRC of the messages of the uncompressed chunk at byte `at`,
    as the chunk's record states them. The size is 0 if there is no chunk record at this place."""
    if at + CHUNK_HEAD > len(view):
        return 0, 0
    _, length = RECORD.unpack_from(view, at)
    first, last, size, crc, name_length = CHUNK.unpack_from(view, at + RECORD.size)
    (inner,) = LONG_LENGTH.unpack_from(view, at + RECORD.size + CHUNK.size)
    if name_length or not topics.EPOCH_NS <= first <= last < topics.EPOCH_NS + MAX_DURATION_NS:
        return 0, 0
    outer = length - (CHUNK_HEAD - RECORD.size)
    agreed = size if size in (inner, outer) else inner if inner == outer else 0
    return agreed, crc


def _has_message_index(view: memoryview, at: int) -> bool:
    """Whether a message index record begins at byte `at`, as it does after every whole chunk."""
    if at + RECORD.size > len(view):
        return False
    opcode, length = RECORD.unpack_from(view, at)
    return bool(opcode == Opcode.MESSAGE_INDEX and at + RECORD.size + length <= len(view))


def _parse_messages(data: memoryview) -> tuple[list[FoundMessage], bool]:
    """Return the complete messages at the start of `data`, and whether message records fill `data`
    to its end. False means that other bytes follow."""
    names = list(topics.MESSAGE_TYPES)  # channel numbers follow this order, from 1
    found: list[FoundMessage] = []
    at = 0
    while at + MESSAGE.size <= len(data):
        opcode, length, channel, step, log_time, again = MESSAGE.unpack_from(data, at)
        end = at + RECORD.size + length
        if opcode == Opcode.MESSAGE:
            if not 1 <= channel <= len(names) or log_time != again:
                return found, False
            if end <= len(data):
                payload = data[at + MESSAGE.size : end]
                found.append(FoundMessage(names[channel - 1], step, log_time, payload))
        elif opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            return found, False
        if end > len(data):
            return found, True
        at = end
    return found, at == len(data) or data[at] == Opcode.MESSAGE
