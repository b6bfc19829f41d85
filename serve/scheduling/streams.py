"""The newest frame of each stream, over all workers.

A frame's stamp is the time at which its request began, in ns of the machine's monotonic clock,
which is the same for all processes. A queued frame is announced; a frame is superseded when its
stream has a later stamp.
"""

from functools import lru_cache
from hashlib import blake2b

from serve.workers.shared_memory import PROBES, STREAM_ENTRIES, STREAM_WORDS

EXPIRY_NS = 10_000_000_000  # longer than any frame waits; then another stream may take the entry


@lru_cache(4096)
def stream_key(client: str, name: str) -> int:
    """The key of a client's stream, never 0. Streams of two clients are never the same."""
    digest = blake2b(f"{client}\0{name}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") | 1


class StreamTable:
    """The newest stamp of each stream: (key, stamp) in open addressing."""

    def __init__(self, cells: "memoryview[int]") -> None:
        self._cells = cells

    def announce(self, key: int, stamp_ns: int) -> None:
        """Record a queued frame. Nothing is recorded where the table has no free entry."""
        cells = self._cells
        free = -1
        for at in _indices(key):
            if cells[at] == key:
                # Two workers at once may lose one of two stamps: then an old frame is answered,
                # which does no harm.
                if cells[at + 1] < stamp_ns:
                    cells[at + 1] = stamp_ns
                return
            if free < 0 and cells[at + 1] + EXPIRY_NS < stamp_ns:
                free = at
        if free >= 0:
            cells[free + 1] = 0
            cells[free] = key
            cells[free + 1] = stamp_ns

    def is_superseded(self, key: int, stamp_ns: int) -> bool:
        """Whether a frame newer than `stamp_ns` was announced for this stream."""
        cells = self._cells
        for at in _indices(key):
            if cells[at] == key:
                return bool(cells[at + 1] > stamp_ns)
        return False


def _indices(key: int) -> list[int]:
    return [(key + probe) % STREAM_ENTRIES * STREAM_WORDS for probe in range(PROBES)]
