"""What the connections of one worker share: limits, deadlines' clock, and who gives way to whom.

Each connection is in one group, by what it waits for; within a group those that have waited for
longest come first. While the service has as many connections as it takes, a new one ends another:
one that was refused and lingers, one that sends its request slowly, the one that has been idle for
longest, a WebSocket without messages. One whose last image was answered goes after those that have
sent none. A client with many connections cannot end those of one with fewer; it gives way to it.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from ipaddress import ip_address, ip_network
from typing import Protocol, runtime_checkable

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from serve.api.problems import TOO_MANY_CONNECTIONS, ProblemType
from serve.config import Limits, network_of
from serve.scheduling.body_budget import BodyBudget

LINGER_S = 0.5  # for a client to read the problem before its connection is closed
DRAIN_S = 1.0  # for clients to send one more request, answered with Connection: close
EVICTABLE_S = 0.1  # connections in headers or a body for longer give way to new ones
REFUSAL_PAUSE_S = 0.002  # for which refused clients are not read while the queue is full


class Guarded(Protocol):
    """A connection as its guard sees it."""

    since_s: float
    group: "Group"
    network: str
    """Of its client; empty for a trusted proxy, which has many clients."""

    def give_way(self) -> None:
        """End the connection: a new one needs its place."""

    def expire(self, now: float) -> None:
        """End the connection if its deadline has passed."""

    def end_slow_body(self, now: float) -> int:
        """End the connection if a body has been arriving for EVICTABLE_S; the bytes it held."""


@runtime_checkable
class Drained(Protocol):
    """A connection as a worker that stops sees it."""

    lingers: bool
    """Its last bytes are sent; the client has still to close it."""

    def begin_draining(self) -> None:
        """Say with the next reply that it is the last one."""

    def drain(self, elapsed_s: float) -> bool:
        """Close it if nothing is owed to the client, `elapsed_s` after that; whether that is so."""

    def end_draining(self) -> None:
        """End it, with a reply to what is still owed."""


Group = dict[Guarded, None]


def _group() -> Group:
    return {}


@dataclass
class ConnectionGuard:
    """State that the connections of one worker share."""

    limits: Limits
    other_connections: Callable[[], int] = lambda: 0
    """Counts the connections of the other workers."""
    ask_for_room: Callable[[int], None] = lambda _least: None
    """Asks another worker to end a connection; `least` as in `make_room`."""
    count_closed: Callable[[ProblemType], None] = lambda _type: None
    bodies: BodyBudget | None = None
    """The budget for messages of WebSockets that are incomplete; None: there is none."""
    reading: Guarded | None = None
    """The connection that received something last."""
    clock: Callable[[], float] = time.monotonic
    """Time for the deadlines, s."""
    draining: bool = False
    receiving: Group = field(default_factory=_group)
    """In the middle of headers or a body."""
    working: Group = field(default_factory=_group)
    """Waiting for an answer."""
    idle: Group = field(default_factory=_group)
    """Between requests, without an image that was answered."""
    served: Group = field(default_factory=_group)
    """Between requests, after an image that was answered."""
    streams: Group = field(default_factory=_group)
    """WebSockets, by their last message."""
    refused: Group = field(default_factory=_group)
    """Refused, and open for LINGER_S only so that the client can read why."""
    closing: Group = field(default_factory=_group)
    """Ended, but still counted by the server for a moment."""
    open: Counter[str] = field(default_factory=Counter)
    """Connections by the network of their client."""
    paused: list[HttpToolsProtocol] = field(default_factory=list)
    """Connections that are not read because they were refused while the queue is full."""

    def admit(self, connection: Guarded, address: str) -> None:
        """Count a new connection from an address."""
        if not _is_any_of(address, self.limits.trusted_proxies):
            connection.network = network_of(address)
            self.open[connection.network] += 1

    def place(self, connection: Guarded, group: Group) -> float:
        """Move a connection to the end of a group; the time, s."""
        connection.group.pop(connection, None)
        connection.group = group
        group[connection] = None
        connection.since_s = now = self.clock()
        return now

    def forget(self, connection: Guarded) -> None:
        """Let go of a connection that has ended."""
        connection.group.pop(connection, None)
        if self.reading is connection:
            self.reading = None
        if connection.network:
            self.open[connection.network] -= 1
            if not self.open[connection.network]:
                del self.open[connection.network]

    def make_room_for(self, newcomer: Guarded, excess: int) -> bool:
        """End `excess` connections; False: not so many give way, and another worker is asked."""
        least = self._count(newcomer)
        made = self.make_room(excess, least)
        if not made:
            self.ask_for_room(least)
        return made

    def make_room(self, excess: int, least: int) -> bool:
        """End `excess` connections, the least useful first; False: not so many give way.

        `least`: how many connections the newcomer's client has. Those of clients with fewer stay;
        when all others are too young, those of clients with more are ended.
        """
        for group, age_s, count in (
            (self.refused, 0.0, 0),
            (self.receiving, EVICTABLE_S, least),
            (self.idle, 0.0, least),
            (self.served, 0.0, least),
            (self.streams, self.limits.idle_s, least),
            (self.receiving, 0.0, least + 1),
            (self.streams, 0.0, least + 1),
        ):
            if excess > 0:
                excess -= self._end_oldest(group, excess, age_s, count)
        return excess <= 0

    def _end_oldest(self, group: Group, most: int, age_s: float, count: int) -> int:
        """End up to `most` connections of an age, and of clients with `count` or more; how many."""
        now, ended = self.clock(), 0
        for connection in list(group):
            if ended == most or now - connection.since_s < age_s:
                break
            if self._count(connection) < count:
                continue
            connection.give_way()
            self.place(connection, self.closing)
            self.count_closed(TOO_MANY_CONNECTIONS)
            ended += 1
        return ended

    def _count(self, connection: Guarded) -> int:
        """How many connections its client has; a trusted proxy counts as many clients."""
        return self.open[connection.network] if connection.network else 1

    def end_slow_bodies(self, size: float) -> float:
        """End connections whose bodies arrive slowly, until these held `size` bytes; how many.

        Those of an ASGI request are free only when its task has noticed.
        """
        now, freed = self.clock(), 0
        for connection in (*self.receiving, *self.streams):
            if freed >= size:
                break
            if connection is not self.reading:
                freed += connection.end_slow_body(now)
        return freed

    def pause_reading(self, connection: HttpToolsProtocol) -> None:
        """Read no more from a refused client for REFUSAL_PAUSE_S.

        Its next request, and those of others refused meanwhile, are then handled together. Waking
        the loop for each of them would take the core from the engine.
        """
        if not self.paused:
            connection.loop.call_later(REFUSAL_PAUSE_S, self._resume_reading)
        connection.flow.pause_reading()
        self.paused.append(connection)

    def _resume_reading(self) -> None:
        paused, self.paused = self.paused, []
        for connection in paused:
            if not (connection.transport.is_closing() or connection.flow.write_paused):
                connection.flow.resume_reading()


def _is_any_of(address: str, networks: Iterable[str]) -> bool:
    try:
        found = ip_address(address.partition("%")[0])
    except ValueError:  # no address, as that of a Unix socket
        return False
    return any(found in ip_network(network, strict=False) for network in networks)


def close_expired(connections: Iterable[object], now: float) -> None:
    """Close the connections whose deadline has passed; `now` in s of the guard's clock."""
    for connection in list(connections):
        expire = getattr(connection, "expire", None)
        if expire is not None:
            expire(now)
