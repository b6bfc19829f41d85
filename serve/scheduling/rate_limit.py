"""How often a client may ask: a token bucket an address, over all workers.

The buckets lie in shared memory without a lock: two workers at once may count two requests as one,
which lets a client have a little more than its share and never less.
"""

import time
from functools import lru_cache
from hashlib import blake2b

from serve.api.problems import RATE_LIMITED, Problem
from serve.config import is_loopback
from serve.workers.shared_memory import CLIENT_SLOTS, CLIENT_WORDS

PROBES = 8


@lru_cache(4096)
def client_key(address: str) -> float:
    """The number of a client, never 0 and held by a real without loss; 0 for this machine."""
    if not address or is_loopback(address):
        return 0.0
    digest = blake2b(address.encode(), digest_size=6).digest()
    return float(int.from_bytes(digest, "big") + 1)


class Rate:
    """The table of clients: (key, requests it may still make, when that was so) in s."""

    def __init__(self, cells: "memoryview[float]", per_second: float) -> None:
        self._cells = cells
        self._rate = per_second

    def check(self, address: str, now: float | None = None) -> None:
        """Count a request of a client; raise Problem when it asks too often."""
        key = client_key(address)
        if key == 0.0 or self._rate <= 0:
            return
        cells, now = self._cells, time.monotonic() if now is None else now
        at = self._place(key, now)
        left = min(self._rate, cells[at + 1] + (now - cells[at + 2]) * self._rate)
        cells[at + 2] = now
        if left < 1.0:
            cells[at + 1] = left
            raise Problem(
                RATE_LIMITED,
                f"this client asks more than {self._rate:g} times a second; ask less often, or "
                "start the service with a higher --rate",
                1e3 * (1.0 - left) / self._rate,
            )
        cells[at + 1] = left - 1.0

    def _place(self, key: float, now: float) -> int:
        """Where the client's bucket is; of a new client, full, in the place unused for longest."""
        cells = self._cells
        first = int(key) % CLIENT_SLOTS
        places = [(first + n) % CLIENT_SLOTS * CLIENT_WORDS for n in range(PROBES)]
        for at in places:
            if cells[at] == key:
                return at
        oldest = min(places, key=lambda at: cells[at + 2])
        cells[oldest], cells[oldest + 1], cells[oldest + 2] = key, self._rate, now
        return oldest
