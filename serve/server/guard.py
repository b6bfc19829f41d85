"""State shared by the connections of one worker: limits, a clock, the choice of connections to end.

Each connection is in one group, according to what it waits for. In a group, the connection that has
waited longest is first. If the number of connections is at its limit, a new connection ends an old
one, in this order: refused connections that still read, requests that arrive slowly, idle
connections (first those without an answered image), WebSockets without messages. A new connection
never ends a connection of a client that has fewer connections than the new connection's client.
Only the connections of this worker are counted.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from ipaddress import ip_address, ip_network
from typing import Protocol

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from serve.config import Limits, network_of
from serve.problems import TOO_MANY_CONNECTIONS, ProblemType
from serve.scheduling.body_budget import BodyBudget

LINGER_S = 0.5  # time for a client to read the problem before its connection is closed
DRAIN_S = 1.0  # time for clients to send one more request, answered with Connection: close
EVICTABLE_S = 0.1  # headers or a body that take longer are ended in favour of new connections
REFUSAL_PAUSE_S = 0.002  # pause in reading from refused clients while the queue is full
# libuv reads one connection up to 32 times in a row, and 2 MB of frames or chunks take 20 ms to
# parse. So reading pauses after a read of this size until the event loop has run its other work.
PAUSE_BYTES = 32 << 10


class Guarded(Protocol):
    """The interface of a connection for `ConnectionGuard`."""

    since_s: float
    group: "Group"
    network: str
    """The client's network; empty for a trusted proxy, which has many clients."""

    def give_way(self) -> None:
        """End the connection to make room for a new connection."""

    def expire(self, now: float) -> None:
        """End the connection if its deadline is before `now` (in s of the guard's clock)."""

    def end_slow_body(self, now: float) -> int:
        """End the connection if a body has been arriving for 0.1 s (EVICTABLE_S) at `now` (in s);
        returns the number of bytes of the body."""


class Drained(Guarded, Protocol):
    """The interface of a connection for a worker that stops (drains its connections)."""

    lingers: bool
    """Whether the last bytes were sent and the client has not closed the connection yet."""

    def begin_draining(self) -> None:
        """Make the next reply the last one of the connection, and announce this in it."""

    def drain(self, elapsed_s: float) -> bool:
        """Close the connection if all replies to its client have been sent, `elapsed_s` after
        `begin_draining`. Returns whether all replies have been sent."""

    def end_draining(self) -> None:
        """End the connection; refuse the requests that are still unanswered."""


Group = dict[Guarded, None]
Address = tuple[str, int]  # IP address and port


def _group() -> Group:
    return {}


@dataclass
class ConnectionGuard:
    """State that the connections of one worker share."""

    limits: Limits
    other_connections: Callable[[], int] = lambda: 0
    """Returns the number of connections of the other workers."""
    ask_for_room: Callable[[int], None] = lambda _least: None
    """Asks another worker to end a connection of a client with at least this many connections."""
    count_closed: Callable[[ProblemType], None] = lambda _type: None
    """Counts a connection that was closed for this reason."""
    bodies: BodyBudget | None = None
    """The budget for incomplete WebSocket messages; None: no budget."""
    reading: Guarded | None = None
    """The connection that received bytes last."""
    clock: Callable[[], float] = time.monotonic
    """Returns the time for the deadlines in s."""
    draining: bool = False
    receiving: Group = field(default_factory=_group)
    """Connections that are receiving headers or a body."""
    working: Group = field(default_factory=_group)
    """Connections that wait for an answer."""
    idle: Group = field(default_factory=_group)
    """Connections between requests for which no image was answered yet."""
    served: Group = field(default_factory=_group)
    """Connections between requests for which an image was answered."""
    streams: Group = field(default_factory=_group)
    """WebSockets, ordered by their last message."""
    refused: Group = field(default_factory=_group)
    """Refused connections, open for LINGER_S so that the client can read the reason."""
    closing: Group = field(default_factory=_group)
    """Ended connections that the server still counts for a moment."""
    open: Counter[str] = field(default_factory=Counter)
    """Number of connections of each client's network in this worker."""
    paused: list[HttpToolsProtocol] = field(default_factory=list)
    """Connections that are not read for REFUSAL_PAUSE_S; see `pause_reading`."""

    def admit(self, connection: Guarded, client: Address | None) -> Address | None:
        """Count a new connection from `client`; return the client's address.

        A socket on `::` reports the IPv4 address 10.0.0.1 as ::ffff:10.0.0.1; it is returned as
        10.0.0.1, the form in which proxies are given.
        """
        address, port = client or ("", 0)
        if "." in address:
            address = address.removeprefix("::ffff:")
        if not _is_any_of(address, self.limits.trusted_proxies):
            connection.network = network_of(address)
            self.open[connection.network] += 1
        return client and (address, port)

    def place(self, connection: Guarded, group: Group) -> float:
        """Move a connection to the end of a group and restart its waiting time; return the clock's
        time in s."""
        connection.group.pop(connection, None)
        connection.group = group
        group[connection] = None
        connection.since_s = now = self.clock()
        return now

    def forget(self, connection: Guarded) -> None:
        """Remove a connection that has ended."""
        connection.group.pop(connection, None)
        if self.reading is connection:
            self.reading = None
        if connection.network:
            self.open[connection.network] -= 1
            if not self.open[connection.network]:
                del self.open[connection.network]

    def make_room_for(self, newcomer: Guarded, excess: int) -> bool:
        """End `excess` connections so that the new connection `newcomer` can stay. Returns False if
        fewer could be ended; then the worker with the most connections is asked to end one."""
        least = self._count(newcomer)
        made = self.make_room(excess, least)
        if not made:
            self.ask_for_room(least)
        return made

    def make_room(self, excess: int, least: int) -> bool:
        """End `excess` connections: refused, slow, idle, then WebSockets, the oldest first. Returns
        False if fewer could be ended.

        Refused connections of any client are ended; all other connections are ended only if their
        client has at least `least` connections. `least` is the number of connections of the new
        connection's client. A request counts as slow after 0.1 s (EVICTABLE_S), a WebSocket as idle
        after `idle_s` without a message. If too few requests and WebSockets have reached these
        ages, younger ones are ended too, but only of clients with more than `least` connections.
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
        """End up to `most` connections of the group that are at least `age_s` old and whose clients
        have at least `count` connections; returns how many were ended."""
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
        """The number of connections of this connection's client in this worker. Behind a trusted
        proxy it is 1, because each connection can belong to a different client."""
        return self.open[connection.network] if connection.network else 1

    def end_slow_bodies(self, size: float) -> float:
        """End connections whose bodies arrive slowly until they have freed `size` bytes; returns
        the number of freed bytes.

        The bytes of an ASGI request become free later, when its task notices the end.
        """
        now, freed = self.clock(), 0
        for connection in (*self.receiving, *self.streams):
            if freed >= size:
                break
            if connection is not self.reading:
                freed += connection.end_slow_body(now)
        return freed

    def pause_reading(self, connection: HttpToolsProtocol) -> None:
        """Pause reading from a refused client for 2 ms (REFUSAL_PAUSE_S).

        So the event loop handles the next requests of all clients refused in this time together.
        Waking it for each request would take processor time from the engine.
        """
        if not self.paused:
            connection.loop.call_later(REFUSAL_PAUSE_S, self._resume_reading)
        connection.flow.pause_reading()
        self.paused.append(connection)

    def pause_after(self, connection: HttpToolsProtocol, size: int) -> None:
        """After a read of `size` bytes, if these are at least 32 KiB (PAUSE_BYTES), pause reading
        from the connection until the event loop has run its other work."""
        if size >= PAUSE_BYTES and not connection.flow.read_paused:
            connection.flow.pause_reading()
            connection.loop.call_soon(self._read_on, connection)

    def _resume_reading(self) -> None:
        paused, self.paused = self.paused, []
        for connection in paused:
            self._read_on(connection)

    def _read_on(self, connection: HttpToolsProtocol) -> None:
        """Resume reading, unless it is paused for another reason."""
        flow = connection.flow
        if not (
            connection in self.paused or connection.transport.is_closing() or flow.write_paused
        ):
            flow.resume_reading()


def _is_any_of(address: str, networks: Iterable[str]) -> bool:
    try:
        found = ip_address(address.partition("%")[0])
    except ValueError:  # not an IP address, e.g. of a Unix socket
        return False
    return any(found in ip_network(network, strict=False) for network in networks)
