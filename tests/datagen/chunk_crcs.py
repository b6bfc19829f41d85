"""Makes rounds with damaged content but correct CRCs, as a faulty writer would."""

import zlib

from datagen.recording.mcap.footer import read_summary
from datagen.recording.mcap.records import CHUNK, CHUNK_HEAD, RECORD


def with_right_crcs(data: bytes) -> bytes:
    """The round file `data` with the CRC of each chunk computed anew."""
    fixed = bytearray(data)
    for chunk in read_summary(memoryview(data)).chunks:
        head = list(CHUNK.unpack_from(data, chunk.start + RECORD.size))
        messages = data[chunk.start + CHUNK_HEAD : chunk.start + CHUNK_HEAD + head[2]]
        head[3] = zlib.crc32(messages)
        CHUNK.pack_into(fixed, chunk.start + RECORD.size, *head)
    return bytes(fixed)
