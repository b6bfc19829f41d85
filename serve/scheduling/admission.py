"""How much of the engine's time large images may take, by their estimated cost.

A request is not a measure of work: a PNG of 65 KB can take 0.7 s. So a large image is admitted by
the time that its decoding will take: in all, and for each client. A client that is alone may use
the whole engine. Beside others its large images get a quarter of it, and none may take so long that
the others' frames do not fit into the queue meanwhile. Clients are told apart by their address, of
IPv6 by its /64 network.
"""

from collections.abc import Callable

from serve.api.problems import OVERLOADED, Problem
from serve.config import network_of

MAX_PENDING_MS = 1000.0  # of large images that wait or are processed, of all clients
MAX_CLIENT_MS = 250.0  # the same, of one client; one image is always allowed
SHARE = 0.25  # of the engine's time, for the large images of one client beside others
MAX_BESIDE_MS = 200.0  # of one image beside other clients: four frames at 20 Hz
PRESENT_NS = 1_000_000_000  # a client counts as present for so long after a frame
MAX_CLIENTS = 1024  # whose shares are remembered

Client = str


class Admission:
    """Estimated times of large images. For the event loop's thread only."""

    def __init__(self) -> None:
        self._pending_ms = 0.0
        self._client_ms: dict[Client, float] = {}  # pending, by client
        self._credit: dict[Client, tuple[float, int]] = {}  # (ms left, time of that in ns)
        self._newest: tuple[Client, int] = ("", -PRESENT_NS)
        self._other: tuple[Client, int] = ("", -PRESENT_NS)  # the latest of another client

    def note(self, client: Client, now_ns: int) -> None:
        """A client has sent a frame of any size."""
        client = network_of(client)
        if client != self._newest[0]:
            self._other = self._newest
        self._newest = (client, now_ns)

    def admit(self, client: Client, cost_ms: float, now_ns: int) -> Callable[[], None]:
        """Admit a large image; the function to call when it is done. Raises Problem."""
        client = network_of(client)
        own = self._client_ms.get(client, 0.0)
        if own and own + cost_ms > MAX_CLIENT_MS:
            raise self._too_much(own, "of this client")
        if self._pending_ms and self._pending_ms + cost_ms > MAX_PENDING_MS:
            raise self._too_much(self._pending_ms, "of all clients")
        credit = self._credit_of(client, now_ns)
        if self._contended(client, now_ns):
            if cost_ms > MAX_BESIDE_MS:
                raise Problem(
                    OVERLOADED,
                    f"the image would take {cost_ms:.0f} ms; beside other clients at most "
                    f"{MAX_BESIDE_MS:.0f} ms are spent on one: send a smaller one, or a JPEG",
                )
            if credit <= 0.0:
                raise self._too_much(-credit / SHARE, "beyond this client's share")
        while len(self._credit) >= MAX_CLIENTS:
            self._credit.pop(next(iter(self._credit)))
        self._credit.pop(client, None)
        # A client that was alone has not taken from others: it owes for one image at most.
        self._credit[client] = (max(credit, 0.0) - cost_ms, now_ns)
        self._client_ms[client] = own + cost_ms
        self._pending_ms += cost_ms
        return lambda: self._done(client, cost_ms)

    def _credit_of(self, client: Client, now_ns: int) -> float:
        left, since_ns = self._credit.get(client, (MAX_CLIENT_MS, now_ns))
        return min(MAX_CLIENT_MS, left + SHARE * (now_ns - since_ns) / 1e6)

    def _contended(self, client: Client, now_ns: int) -> bool:
        latest = self._other if self._newest[0] == client else self._newest
        return now_ns - latest[1] < PRESENT_NS

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
            "ones, or this one later",
            waiting_ms,
        )
