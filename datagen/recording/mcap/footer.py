"""Reads the footer and summary section of an MCAP file: channels, chunks, metadata, counts.

The official reader builds an object for each of thousands of entries, which takes seconds for many
rounds; a test compares both. Source of the format: mcap.dev/spec.
"""

import zlib
from dataclasses import dataclass, field

from mcap.opcode import Opcode

from datagen.recording.mcap.records import (
    CHANNEL_COUNT,
    CHUNK_INDEX,
    CRC_BYTES,
    DATA_END,
    FOOTER,
    INDEX_OFFSET,
    LENGTH,
    LONG_LENGTH,
    MAGIC,
    STATISTICS,
    records,
    text,
    text_map,
)


@dataclass(frozen=True, slots=True)
class ChunkIndex:
    """Place of a chunk in an MCAP file. `start` is its file offset (bytes); `indexes` are the file
    offsets of its message indexes, by channel."""

    start: int
    compression: str
    indexes: dict[int, int]


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of an MCAP file: channel numbers by topic, chunks, metadata records as (start, end)
    in bytes by name, and message counts by channel."""

    channels: dict[str, int] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    metadata: dict[str, tuple[int, int]] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)


def read_summary(view: memoryview) -> Summary:
    """Read the summary of an MCAP file and check it against its CRC; empty if the file has none.

    Raises ValueError if the file is no complete MCAP file or its summary is damaged.
    """
    found = Summary()
    start, end = _summary_bounds(view)
    if not start:
        return found
    for opcode, at, _ in records(view, start, end):
        if opcode == Opcode.CHANNEL:
            topic, _ = text(view, at + 4)
            found.channels[topic] = int.from_bytes(view[at : at + 2], "little")
        elif opcode == Opcode.CHUNK_INDEX:
            found.chunks.append(_chunk(view, at))
        elif opcode == Opcode.METADATA_INDEX:
            offset, length = (LONG_LENGTH.unpack_from(view, at + i)[0] for i in (0, 8))
            found.metadata[text(view, at + 16)[0]] = (offset, offset + length)
        elif opcode == Opcode.STATISTICS:
            after = at + STATISTICS.size
            size = STATISTICS.unpack_from(view, at)[-1]
            found.counts.update(CHANNEL_COUNT.iter_unpack(view[after : after + size]))
    return found


def read_metadata(view: memoryview, place: tuple[int, int]) -> dict[str, str]:
    """Read the metadata record at `place`, (start, end) in bytes. Raises ValueError if there is
    none."""
    for opcode, at, _ in records(view, *place):
        if opcode == Opcode.METADATA:
            _, after = text(view, at)
            return text_map(view, after)
    raise ValueError("there is no metadata record where the index points")


def _summary_bounds(view: memoryview) -> tuple[int, int]:
    """Start and end of the summary section; start 0 if there is none."""
    footer_at = len(view) - len(MAGIC) - FOOTER.size
    if footer_at < len(MAGIC) + DATA_END.size:
        raise ValueError(f"{len(view)} bytes are too few for an MCAP file")
    if view[: len(MAGIC)] != MAGIC:
        raise ValueError("it does not start with the MCAP magic")
    if view[-len(MAGIC) :] != MAGIC:
        raise ValueError("its end is missing (it does not end with the MCAP magic)")
    opcode, length, start, _, crc = FOOTER.unpack_from(view, footer_at)
    if (opcode, length) != (Opcode.FOOTER, FOOTER.size - 9):
        raise ValueError("its footer is missing or damaged")
    if start and not len(MAGIC) + DATA_END.size <= start <= footer_at:
        raise ValueError("its footer has no position of the index")
    covered = footer_at + FOOTER.size - CRC_BYTES
    if start and crc and zlib.crc32(view[start:covered]) != crc:
        raise ValueError("its index is damaged (the summary's CRC)")
    return start, footer_at


def _chunk(view: memoryview, at: int) -> ChunkIndex:
    _, _, start, _, size = CHUNK_INDEX.unpack_from(view, at)
    at += CHUNK_INDEX.size
    indexes = dict(INDEX_OFFSET.iter_unpack(view[at : at + size]))
    at += size + LONG_LENGTH.size  # skips the field with the total length of the message indexes
    (length,) = LENGTH.unpack_from(view, at)
    return ChunkIndex(start, text(view, at)[0] if length else "", indexes)
