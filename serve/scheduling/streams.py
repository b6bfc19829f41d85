"""Which frame of a stream is the newest, over all workers.

A frame's stamp is the time its request began, in ns of the machine's monotonic clock, the same for
all processes. An admitted frame is announced; one whose stream has a later stamp is superseded.
"""

from functools import lru_cache
from hashlib import blake2b

from serve.workers.shared_memory import STREAM_SLOTS, STREAM_WORDS

PROBES = 8
FORGOTTEN_NS = 10_000_000_000  # no frame waits this long: the slot may go to another stream


@lru_cache(4096)
def stream_key(client: str, name: str) -> int:
    """The number of a client's stream, never 0. Two clients' streams of one name are two."""
    digest = blake2b(f"{client}\0{name}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") | 1


class Streams:
    """The table of streams: (key, newest stamp) in open addressing."""

    def __init__(self, cells: "memoryview[int]") -> None:
        self._cells = cells

    def announce(self, key: int, stamp: int) -> None:
        """Say that a frame was admitted. With no room left in the table, nothing is said."""
        cells = self._cells
        free = -1
        for at in _places(key):
            if cells[at] == key:
                # Two workers at once may lose one of two announcements: then an old frame is
                # answered, which is no fault.
                if cells[at + 1] < stamp:
                    cells[at + 1] = stamp
                return
            if free < 0 and cells[at + 1] + FORGOTTEN_NS < stamp:
                free = at
        if free >= 0:
            cells[free + 1] = 0
            cells[free] = key
            cells[free + 1] = stamp

    def superseded(self, key: int, stamp: int) -> bool:
        """Whether a newer frame than this was admitted to its stream."""
        cells = self._cells
        for at in _places(key):
            if cells[at] == key:
                return bool(cells[at + 1] > stamp)
        return False


def _places(key: int) -> list[int]:
    return [(key + probe) % STREAM_SLOTS * STREAM_WORDS for probe in range(PROBES)]
