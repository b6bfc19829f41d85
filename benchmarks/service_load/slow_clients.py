"""Clients that hold connections open: half of them never end the headers of their request, the rest
never end its body.

    python benchmarks/service_load/slow_clients.py PORT COUNT      # runs until it is killed

Each client sends one byte per second. If the server closes its connection, the client connects
again a second later.
"""

import random
import selectors
import socket
import sys
import time
from contextlib import suppress

HEAD = b"POST /features HTTP/1.1\r\nHost: localhost\r\nContent-Type: image/jpeg\r\n"
BEGINS = (HEAD + b"X-Slow: ", HEAD + b"Content-Length: 20000\r\n\r\n\xff\xd8\xff")
PAUSE_S = 1.0
TICK_S = 0.005


class Slow:
    """One slow client; `due` is the time (s, monotonic) of its next action."""

    def __init__(self, number: int, port: int, start: float) -> None:
        self._begin = BEGINS[number % 2]
        self._port = port
        self._socket: socket.socket | None = None
        self.due = start

    def act(self, events: selectors.BaseSelector, now: float) -> None:
        """Connect and send the begin of a request, or send one more byte."""
        self.due = now + PAUSE_S
        try:
            if self._socket is None:
                self._socket = socket.create_connection(("127.0.0.1", self._port))
                self._socket.setblocking(False)
                events.register(self._socket, selectors.EVENT_READ, self)
                self._socket.sendall(self._begin)
            else:
                self._socket.sendall(b"a")
        except BlockingIOError:
            pass
        except OSError:
            self.leave(events, now)

    def hear(self, events: selectors.BaseSelector, now: float) -> None:
        """Read and ignore the bytes that the server sends; leave if the server has closed the
        connection."""
        assert self._socket is not None
        part = b""
        with suppress(OSError):
            part = self._socket.recv(65536)
        if not part:
            self.leave(events, now)

    def leave(self, events: selectors.BaseSelector, now: float) -> None:
        """Close the connection. The client connects again after PAUSE_S."""
        if self._socket is not None:
            with suppress(KeyError):
                events.unregister(self._socket)
            self._socket.close()
            self._socket = None
        self.due = now + PAUSE_S


def main() -> None:
    port, count = int(sys.argv[1]), int(sys.argv[2])
    rng, now = random.Random(0), time.monotonic()
    crowd = [Slow(number, port, now + rng.random()) for number in range(count)]
    events = selectors.DefaultSelector()
    while True:
        ready = events.select(TICK_S)
        now = time.monotonic()
        for key, _ in ready:
            key.data.hear(events, now)
        for client in crowd:
            if client.due <= now:
                client.act(events, now)


if __name__ == "__main__":
    main()
