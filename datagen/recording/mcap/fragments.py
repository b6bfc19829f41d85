"""What is whole in a damaged MCAP file: its chunks found by their own checksums, not by an index.

A chunk tells its size three times and carries a CRC: wherever two of the three agree and the CRC
fits, there is a whole chunk. Source: mcap.dev/spec (Chunk).
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
LONGEST_NS = 366 * 86_400 * topics.NANOSECONDS


@dataclass(frozen=True, slots=True)
class Piece:
    """The messages of a chunk: `whole` when its CRC says so, else cut or overwritten at its end."""

    data: memoryview
    whole: bool


@dataclass(frozen=True, slots=True)
class Fragment:
    """A message that was found."""

    topic: str
    step: int
    log_time: int
    payload: memoryview


def pieces(data: bytes) -> Iterator[Piece]:
    """All whole chunks and, after the last of them, what there is of one that was being written.

    A chunk with a wrong CRC that others or its index follow is left out: any of it may be wrong.
    """
    view = memoryview(data)
    at, torn = 0, None
    while (at := data.find(CHUNK_OPCODE, at)) >= 0:
        size, crc = _chunk_at(view, at)
        messages = view[at + CHUNK_HEAD : at + CHUNK_HEAD + size]
        if size and len(messages) == size and zlib.crc32(messages) == crc:
            yield Piece(messages, whole=True)
            at, torn = at + CHUNK_HEAD + size, None
            continue
        if size and torn is None and not _index_at(view, at + CHUNK_HEAD + size):
            torn = Piece(messages, whole=False)
        at += 1
    if torn is not None:
        yield torn


def fragments(piece: Piece) -> Iterator[Fragment]:
    """The messages of a piece, front to back, as far as they are sure to be what was written."""
    found, cut = _messages(piece.data)
    # Where something else follows, it may have begun in the last message already.
    yield from found if piece.whole or cut else found[:-1]


def metadata(data: bytes, name: str) -> dict[str, str] | None:
    """The metadata record of that name, wherever it is; None without one, or with half of one."""
    at = data.find(LENGTH.pack(len(name)) + name.encode())
    if at < 0:
        return None
    view = memoryview(data)
    try:
        return text_map(view, read_text(view, at)[1])
    except (ValueError, struct.error):
        return None


def _chunk_at(view: memoryview, at: int) -> tuple[int, int]:
    """Size and CRC of the messages of an uncompressed chunk that begins here; size 0 when none."""
    if at + CHUNK_HEAD > len(view):
        return 0, 0
    _, length = RECORD.unpack_from(view, at)
    first, last, size, crc, name = CHUNK.unpack_from(view, at + RECORD.size)
    (inner,) = LONG_LENGTH.unpack_from(view, at + RECORD.size + CHUNK.size)
    if name or not topics.EPOCH_NS <= first <= last < topics.EPOCH_NS + LONGEST_NS:
        return 0, 0
    outer = length - (CHUNK_HEAD - RECORD.size)
    agreed = size if size in (inner, outer) else inner if inner == outer else 0
    return agreed, crc


def _index_at(view: memoryview, at: int) -> bool:
    """Whether a message index lies here, as after every chunk."""
    if at + RECORD.size > len(view):
        return False
    opcode, length = RECORD.unpack_from(view, at)
    return bool(opcode == Opcode.MESSAGE_INDEX and at + RECORD.size + length <= len(view))


def _messages(data: memoryview) -> tuple[list[Fragment], bool]:
    """The messages, and whether nothing but the end of the data ended them."""
    names = list(topics.MESSAGE_TYPES)  # channels are numbered in this order, from 1
    found: list[Fragment] = []
    at = 0
    while at + MESSAGE.size <= len(data):
        opcode, length, channel, step, log_time, again = MESSAGE.unpack_from(data, at)
        end = at + RECORD.size + length
        if opcode == Opcode.MESSAGE:
            if not 1 <= channel <= len(names) or log_time != again:
                return found, False
            if end <= len(data):
                payload = data[at + MESSAGE.size : end]
                found.append(Fragment(names[channel - 1], step, log_time, payload))
        elif opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            return found, False
        if end > len(data):
            return found, True
        at = end
    return found, at == len(data) or data[at] == Opcode.MESSAGE
