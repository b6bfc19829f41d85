"""Whether the bytes of an MCAP file are those its own checksums were taken of.

Two of them cover every byte of a file with a summary: one the data section, one the summary and the
footer. Source: mcap.dev/spec (DataEnd, Footer). Zero stands for a checksum that was not taken.
"""

import struct
import zlib
from collections.abc import Iterator
from mmap import ACCESS_READ, mmap
from pathlib import Path

from mcap.opcode import Opcode

from .index import MAGIC

DATA_END = struct.Struct("<BQI")  # opcode, length, CRC of all before it
FOOTER = struct.Struct("<BQQQI")  # opcode, length, summary start, offset start, CRC of the summary
CRC_BYTES = 4


def wrong_checksums(path: Path) -> Iterator[str]:
    """What does not fit, one line each."""
    with path.open("rb") as stream, mmap(stream.fileno(), 0, access=ACCESS_READ) as data:
        footer_at = len(data) - len(MAGIC) - FOOTER.size
        if footer_at < len(MAGIC) + DATA_END.size:
            yield f"{len(data)} bytes are too few for an MCAP file"
            return
        kind, length, start, _, summary_crc = FOOTER.unpack_from(data, footer_at)
        if (kind, length) != (Opcode.FOOTER, FOOTER.size - 9):
            yield "its footer is not where it belongs"
            return
        if not len(MAGIC) + DATA_END.size <= start <= footer_at:
            yield "it has no index at its end, or the footer does not say where"
            return
        with memoryview(data) as view:
            covered = footer_at + FOOTER.size - CRC_BYTES
            if summary_crc and zlib.crc32(view[start:covered]) != summary_crc:
                yield "its index is damaged (the summary's CRC)"
            end = start - DATA_END.size
            kind, length, data_crc = DATA_END.unpack_from(view, end)
            if (kind, length) != (Opcode.DATA_END, CRC_BYTES):
                yield "its data section has no end"
            elif data_crc and zlib.crc32(view[:end]) != data_crc:
                yield "its data section is damaged (the section's CRC)"
