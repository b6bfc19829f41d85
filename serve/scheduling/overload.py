"""Refuses frames under overload: a frame for which the queue has no room, and a large image that
would use too much of the engine's time.

The size of a request does not measure its work: a PNG of 65 KB can take 0.7 s. So large images are
admitted by their estimated decoding time, with limits for all clients and for each client. A client
that is alone can use the whole engine. While other clients are present, its large images get a
quarter of the engine's time, and an image is refused if the other clients' frames would overflow
the queue while it is decoded. A client is an IPv4 address or an IPv6 /64 network.
"""

from collections.abc import Callable
from functools import lru_cache

from serve.config import network_of
from serve.problems import OVERLOADED, Problem
from serve.scheduling.fair_queue import FairQueue

# The cost of an image is its estimated decoding time in ms.
MAX_PENDING_MS = 1000.0  # cost of all unfinished large images of all clients
MAX_CLIENT_MS = 250.0  # cost of a client's unfinished large images; one image is always allowed
SHARE = 0.25  # share of the engine's time for a client's large images if other clients are present
MAX_BESIDE_MS = 200.0  # cost of one image if other clients are present: four frames at 20 Hz
MAX_CLIENTS = 1024  # number of clients whose credit is remembered

Client = str


def queue_full(waiting: int, wait_ms: int) -> Problem:
    """Return the problem of a frame that is refused because `waiting` frames fill the queue.
    `wait_ms`: expected time to process them, ms."""
    return Problem(
        OVERLOADED,
        f"{waiting} frames are waiting; send this frame or a newer one later, or start the "
        "service with more --workers",
        wait_ms,
    )


shared_queue_full = lru_cache(64)(queue_full)
"""`queue_full`, with one object for all frames that are refused under the same load."""


class Admission:
    """Admits large images by their estimated decoding time. Use it in the event loop's thread."""

    def __init__(self, waiting: FairQueue) -> None:
        """`waiting` is the frame queue, which records whether other clients have sent frames
        recently."""
        self._waiting = waiting
        self._pending_ms = 0.0
        self._client_ms: dict[Client, float] = {}  # cost of unfinished images
        self._credit: dict[Client, tuple[float, int]] = {}  # (remaining ms, at this time in ns)

    def admit(self, client: Client, cost_ms: float, now_ns: int) -> Callable[[], None]:
        """Admit a large image with the estimated decoding time `cost_ms`, at the time `now_ns` of
        the monotonic clock. Returns a function, which the caller must call when the image has been
        processed. Raises Problem if the image is refused."""
        client = network_of(client)
        own = self._client_ms.get(client, 0.0)
        if own and own + cost_ms > MAX_CLIENT_MS:
            raise self._too_much(own, "of this client")
        if self._pending_ms and self._pending_ms + cost_ms > MAX_PENDING_MS:
            raise self._too_much(self._pending_ms, "of all clients")
        credit = self._credit_of(client, now_ns)
        if self._waiting.others_present(client, now_ns):
            if cost_ms > MAX_BESIDE_MS:
                raise Problem(
                    OVERLOADED,
                    f"the image would take {cost_ms:.0f} ms; while other clients are present, at "
                    f"most {MAX_BESIDE_MS:.0f} ms are allowed: send a smaller image, or a JPEG",
                )
            if credit <= 0.0:
                raise self._too_much(-credit / SHARE, "beyond this client's share")
        while len(self._credit) >= MAX_CLIENTS:
            self._credit.pop(next(iter(self._credit)))
        self._credit.pop(client, None)
        # A client with negative credit is alone here: its images delayed no other client. So its
        # debt is dropped, and a client's debt is never larger than the cost of one image.
        self._credit[client] = (max(credit, 0.0) - cost_ms, now_ns)
        self._client_ms[client] = own + cost_ms
        self._pending_ms += cost_ms
        return lambda: self._done(client, cost_ms)

    def _credit_of(self, client: Client, now_ns: int) -> float:
        left, since_ns = self._credit.get(client, (MAX_CLIENT_MS, now_ns))
        return min(MAX_CLIENT_MS, left + SHARE * (now_ns - since_ns) / 1e6)

    def _done(self, client: Client, cost_ms: float) -> None:
        left = self._client_ms[client] - cost_ms
        if left > 1e-6:
            self._client_ms[client] = left
        else:
            del self._client_ms[client]
        self._pending_ms = sum(self._client_ms.values())

    def _too_much(self, waiting_ms: float, whose: str) -> Problem:
        return Problem(
            OVERLOADED,
            f"large images {whose} already need {waiting_ms:.0f} ms of the engine; send smaller "
            "images, or send this image later",
            waiting_ms,
        )
