"""Records the newest frame of each stream in a table that all workers share.

A frame's stamp is the time at which its request began, in ns of the machine's monotonic clock,
which all processes share. Queued frames are announced with their stamp; a frame is superseded if a
later stamp was announced for its stream.
"""

from functools import lru_cache
from hashlib import blake2b

from serve.shared_memory import PROBES, STREAM_ENTRIES, STREAM_WORDS

# Age of an entry from which another stream can use it; no frame waits that long.
EXPIRY_NS = 10_000_000_000


@lru_cache(4096)
def stream_key(client: str, name: str) -> int:
    """Return the key of a client's stream, never 0. Equal names of two clients are different
    streams."""
    digest = blake2b(f"{client}\0{name}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") | 1


class StreamTable:
    """The newest stamp of each stream: `cells` is a hash table of pairs (key, stamp in ns)."""

    def __init__(self, cells: "memoryview[int]") -> None:
        self._cells = cells

    def announce(self, key: int, stamp_ns: int) -> None:
        """Record the stamp of a queued frame, unless the table has no free entry for its stream."""
        cells = self._cells
        free = -1
        for at in _indices(key):
            if cells[at] == key:
                # No lock: of two simultaneous stamps one can be lost. Then an old frame is
                # answered, which is harmless.
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
