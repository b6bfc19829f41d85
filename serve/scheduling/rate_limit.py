"""Limits the request rate of each client address by a token bucket that all workers share.

The buckets are in shared memory without a lock. Two workers can count two simultaneous requests as
one, so a client can get slightly more than its rate, but never less.
"""

import time
from functools import lru_cache
from hashlib import blake2b

from runtime.access import is_loopback
from serve.config import network_of
from serve.problems import RATE_LIMITED, Problem
from serve.shared_memory import CLIENT_ENTRIES, CLIENT_WORDS, PROBES


@lru_cache(4096)
def client_key(address: str, public: bool = False) -> float:
    """Return the key of a client address in the table of buckets: an integer above 0 that a float
    holds exactly; 0.0 for a loopback address and for an unknown address.

    All addresses of an IPv6 /64 network have the same key. `public` gives another key, for the
    bucket of paths that need no token.
    """
    if not address or is_loopback(address):
        return 0.0
    kind = "public " if public else ""
    digest = blake2b(f"{kind}{network_of(address)}".encode(), digest_size=6).digest()
    return float(int.from_bytes(digest, "big") + 1)


class RateLimiter:
    """Limits the request rate of all clients. `cells` holds each client's bucket: (key, remaining
    tokens, time of the last update in s)."""

    def __init__(self, cells: "memoryview[float]", per_second: float) -> None:
        self._cells = cells
        self._rate = per_second
        self._burst = max(1.0, per_second)  # a rate below 1/s must still allow a request

    def check(self, address: str, now: float | None = None, public: bool = False) -> None:
        """Count a request of a client; raise Problem if the client exceeds its rate. `now` is in s
        of the monotonic clock; None reads the clock.

        `public`: the path needs no token. These paths have a separate bucket, so that a client that
        floods /features does not make a load balancer's probe from the same address fail.
        """
        key = client_key(address, public)
        if key == 0.0 or self._rate <= 0:
            return
        cells, now = self._cells, time.monotonic() if now is None else now
        at = self._bucket(key, now)
        left = min(self._burst, cells[at + 1] + (now - cells[at + 2]) * self._rate)
        cells[at + 2] = now
        if left < 1.0:
            cells[at + 1] = left
            raise Problem(
                RATE_LIMITED,
                f"this client sends more than {self._rate:g} requests per second; send fewer, or "
                "start the service with a higher --rate",
                1e3 * (1.0 - left) / self._rate,
            )
        cells[at + 1] = left - 1.0

    def _bucket(self, key: float, now: float) -> int:
        """Index in `cells` of the bucket of the client with this `key`. A new client gets, full,
        the bucket that was not used for the longest time among its 8 possible buckets (PROBES).
        `now`: s of the monotonic clock."""
        cells = self._cells
        first = int(key) % CLIENT_ENTRIES
        indices = [(first + n) % CLIENT_ENTRIES * CLIENT_WORDS for n in range(PROBES)]
        for at in indices:
            if cells[at] == key:
                return at
        oldest = min(indices, key=lambda at: cells[at + 2])
        cells[oldest], cells[oldest + 1], cells[oldest + 2] = key, self._burst, now
        return oldest
