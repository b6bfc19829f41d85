"""Binary layout of the MCAP records that are read without the official library.

All numbers are little-endian. Source: mcap.dev/spec.
"""

import struct
from collections.abc import Iterator

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")  # opcode, length of the content
MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
MESSAGE_FIELDS = MESSAGE.size - RECORD.size  # bytes of the content before the payload
CHUNK = struct.Struct("<QQQII")  # first and last time, size, CRC, length of the compression's name
CHUNK_INDEX = struct.Struct("<QQQQI")  # first and last time, start, length, bytes of the offsets
INDEX_OFFSET = struct.Struct("<HQ")  # channel, offset of its message index
MESSAGE_INDEX = struct.Struct("<HI")  # channel, bytes of the entries (log time, offset)
STATISTICS = struct.Struct("<QHIIIIQQI")  # counts, times, bytes of the counts by channel
CHANNEL_COUNT = struct.Struct("<HQ")  # channel, messages
DATA_END = struct.Struct("<BQI")  # opcode, length, CRC of all before it
FOOTER = struct.Struct("<BQQQI")  # opcode, length, summary start, offset start, CRC of the summary
LENGTH = struct.Struct("<I")
LONG_LENGTH = struct.Struct("<Q")
CRC_BYTES = 4
# Bytes of an uncompressed chunk record before its messages.
CHUNK_HEAD = RECORD.size + CHUNK.size + LONG_LENGTH.size


def records(view: memoryview, at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start, end of the content) of each record from byte `at` to `end`.

    Raises ValueError for a record that reaches beyond `end`.
    """
    while at < end:
        if at + RECORD.size > end:
            raise ValueError(f"a record is cut at byte {at}")
        opcode, length = RECORD.unpack_from(view, at)
        start = at + RECORD.size
        at = start + length
        if at > end:
            raise ValueError(f"a record at byte {start - RECORD.size} reaches beyond the end")
        yield opcode, start, at


def text(view: memoryview, at: int) -> tuple[str, int]:
    """Read the string at byte `at`; return it and the position after it."""
    (length,) = LENGTH.unpack_from(view, at)
    start = at + LENGTH.size
    if start + length > len(view):
        raise ValueError(f"a string at byte {at} reaches beyond the end")
    return str(view[start : start + length], "utf-8"), start + length


def text_map(view: memoryview, at: int) -> dict[str, str]:
    """Read the map from strings to strings at byte `at`."""
    (length,) = LENGTH.unpack_from(view, at)
    at += LENGTH.size
    end = at + length
    found = {}
    while at < end:
        name, at = text(view, at)
        found[name], at = text(view, at)
    return found
