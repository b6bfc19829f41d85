"""Attacks with HTTP connections. Each is limited in count and time, and stays on this machine.

An attack takes the service's address and returns the connections that it leaves open. The tests run
each attack once. `make attack` repeats them, and the attacks of `websockets` and `costs`, together
with a well-behaved client.
"""

import random
import socket
from collections.abc import Callable
from contextlib import suppress

import cv2
import numpy as np

from tests.serve.attacks.conftest import Target, read_head, send_all
from tests.serve.conftest import JPEG

MANY = 256  # the service's largest number of connections
MB = 1 << 20

Attack = Callable[[Target], list[socket.socket]]


def long_upgrades(target: Target, count: int = MANY) -> list[socket.socket]:
    """Handshakes with a header line of 9 KB, which the WebSocket library refuses."""
    return dial_each(target, count, target.handshake(X_Pad="x" * 9000))


def crowded_upgrades(target: Target, count: int = MANY) -> list[socket.socket]:
    """Handshakes with 200 headers, which the WebSocket library refuses."""
    return dial_each(target, count, target.handshake(**{f"X-{n}": "y" for n in range(200)}))


def endless_trailers(target: Target, megabytes: int = 16) -> list[socket.socket]:
    """A chunked request with an endless number of trailers."""
    connection = _begin_chunked(target)
    send_all(connection, b"0\r\n")
    send_all(connection, b"X-Trailer: %b\r\n" % (b"x" * 1000) * 256, 4 * megabytes)
    return [connection]


def endless_trailer(target: Target, megabytes: int = 16) -> list[socket.socket]:
    """A chunked request with one endless trailer."""
    connection = _begin_chunked(target)
    send_all(connection, b"0\r\nX-Trailer: ")
    send_all(connection, bytes(256 << 10).replace(b"\0", b"x"), 4 * megabytes)
    return [connection]


def endless_chunk_extension(target: Target, megabytes: int = 16) -> list[socket.socket]:
    """A chunked request with an endless chunk extension."""
    connection = _begin_chunked(target)
    send_all(connection, b"5;")
    send_all(connection, bytes(256 << 10).replace(b"\0", b"x"), 4 * megabytes)
    return [connection]


def small_chunks(target: Target, count: int = 4) -> list[socket.socket]:
    """Bodies of 4 MB in chunks of two bytes."""
    connections = [_begin_chunked(target) for _ in range(count)]
    for connection in connections:
        send_all(connection, b"2\r\nxy\r\n" * (1 << 15), 60)
    return connections


def idle_connections(target: Target, count: int = MANY) -> list[socket.socket]:
    """Connections that are idle after one request that needs no token."""
    return dial_each(target, count, target.ask())


def silent_connections(target: Target, count: int = MANY) -> list[socket.socket]:
    """Connections that send nothing."""
    return dial_each(target, count, b"")


def slow_headers(target: Target, count: int = MANY) -> list[socket.socket]:
    """Connections that never end their headers."""
    return dial_each(target, count, b"POST /features HTTP/1.1\r\nHost: localhost\r\nX-Slow: ")


def slow_bodies(target: Target, count: int = MANY) -> list[socket.socket]:
    """Connections that never end their bodies."""
    return dial_each(target, count, target.post(JPEG)[:-100])


def churn(target: Target, count: int = 2 * MANY) -> list[socket.socket]:
    """One after the other, more connections than the service allows, each with a request."""
    connections = dial_each(target, count, target.ask(path="/nothing"))
    return connections[-MANY:]


def left_uploads(target: Target, count: int = 120) -> list[socket.socket]:
    """Clients that disconnect in the middle of a body of 2 MB."""
    for _ in range(count):
        with suppress(OSError), target.dial() as connection:
            connection.sendall(target.post(bytes(2 * MB))[:-1000])
    return []


def refused_uploads(target: Target, count: int = 60) -> list[socket.socket]:
    """Bodies that are refused in the middle because of an invalid chunk."""
    connections = []
    for _ in range(count):
        connection = _begin_chunked(target)
        send_all(connection, b"%x\r\n%b\r\nno chunk\r\n" % (2 * MB, bytes(2 * MB)))
        connections.append(connection)
    return connections


def pipelined_floods(target: Target, count: int = 8) -> list[socket.socket]:
    """Thousands of small pipelined requests, which need no token."""
    return dial_each(target, count, target.ask() * 4000)


def refused_floods(target: Target, count: int = 8) -> list[socket.socket]:
    """Thousands of pipelined frames that are refused."""
    return dial_each(target, count, target.post(b"") * 4000)


def h2c_in_two_segments(target: Target, count: int = 64) -> list[socket.socket]:
    """Requests with an upgrade to HTTP/2, whose body looks like another request."""
    inner = target.ask(path="/model")
    whole = target.post(
        inner, Connection="Upgrade, HTTP2-Settings", Upgrade="h2c", HTTP2_Settings=""
    )
    connections = dial_each(target, count, whole[: -len(inner)])
    for connection in connections:
        send_all(connection, inner)
    return connections


def upgrade_floods(target: Target, count: int = 8) -> list[socket.socket]:
    """Thousands of pipelined requests with an upgrade to HTTP/2."""
    return dial_each(target, count, target.ask(Connection="Upgrade", Upgrade="h2c") * 2000)


def tunnels(target: Target, count: int = 64) -> list[socket.socket]:
    """Requests with CONNECT, which is for proxies."""
    return dial_each(target, count, b"CONNECT 127.0.0.1:22 HTTP/1.1\r\nHost: localhost\r\n\r\n" * 3)


def strange_headers(target: Target, count: int = 40) -> list[socket.socket]:
    """Header values that Python's parsing functions do not expect."""
    zeros = "0" * 5000
    bodies = [
        target.post(b"{}", "/v2/models/track/infer", Inference_Header_Content_Length=zeros),
        target.post(b"", X_Deadline_Ms=zeros, Content_Length=zeros),
        target.post(JPEG, X_Deadline_Ms="1e400", X_Camera_Fov_Y="\u0661"),
        target.handshake(Origin="http://["),
        target.post(JPEG, Origin="http://["),
        target.post(JPEG, Host="["),
        target.ask(path="/%ff%00?fov_y=%ff"),
    ]
    return [
        connection
        for body in bodies
        for connection in dial_each(target, count // len(bodies), body)
    ]


def damaged_images(target: Target, count: int = 100) -> list[socket.socket]:
    """Damaged PNG files; libpng writes a line to stderr for each."""
    rng = np.random.default_rng(1)
    whole = cv2.imencode(".png", rng.integers(0, 256, (210, 280, 3), np.uint8))[1].tobytes()
    connection = target.dial()
    for _ in range(count):
        body = bytearray(whole)
        body[int(rng.integers(60, len(body)))] ^= 1 << int(rng.integers(8))
        with suppress(OSError, ValueError):
            connection.sendall(target.post(bytes(body), Content_Type="image/png"))
            read_head(connection)
    return [connection]


def mutated_requests(target: Target, count: int = 100, seed: int = 0) -> list[socket.socket]:
    """Requests and WebSocket streams with changed, deleted or repeated bytes."""
    rng, whole = random.Random(seed), whole_streams(target)
    connections = []
    for _ in range(count):
        connections += dial_each(target, 1, mutate(rng, whole))
    return connections[-64:]


CONNECTIONS: tuple[Attack, ...] = tuple(
    found
    for name, found in list(vars().items())
    if callable(found)
    and getattr(found, "__module__", None) == __name__
    and not name.startswith("_")
)


def whole_streams(target: Target) -> list[bytes]:
    """Valid streams of each kind that the service accepts."""
    chunks = b"3\r\nabc\r\n2;x=y\r\nde\r\n0\r\nX-T: 1\r\n\r\n"
    coded = {"Transfer_Encoding": "chunked", "Content_Type": "image/png"}
    return [
        target.post(JPEG[:500]),
        target.post(b"", Expect="100-continue", X_Forwarded_For="10.0.0.1") + target.ask(),
        target.handshake(Origin="http://x") + b"\x88\x82\0\0\0\0\x03\xe8",
        target.handshake(Sec_WebSocket_Protocol="driverview.msgpack"),
        target.ask("POST", "/features", **coded) + chunks,
        target.ask("POST", "/v2/models/track/infer", **coded) + chunks,
        target.ask(Connection="Upgrade, close", Upgrade="h2c") * 2,
        target.ask(path="/metrics?x=%41#y", Accept="text/*;q=0.5, */*;q=x"),
    ]


def mutate(rng: random.Random, whole: list[bytes]) -> bytes:
    """One of the streams with changed, deleted or repeated bytes."""
    sent = bytearray(rng.choice(whole))
    for _ in range(rng.randrange(6)):
        at, size = rng.randrange(len(sent)), rng.randrange(1, 20)
        match rng.randrange(5):
            case 0:
                sent[at] = rng.randrange(256)
            case 1:
                del sent[at : at + size]
                sent += b"\r\n"
            case 2:
                sent[at:at] = sent[at : at + size] * rng.randrange(1, 50)
            case 3:
                sent[at:at] = rng.choice([b"\r\n", b"\0", b"\r\n\r\n", b"0" * 30, b"\xff", b":"])
            case 4:
                sent += rng.choice(whole)
    return bytes(sent)


def dial_each(target: Target, count: int, sent: bytes) -> list[socket.socket]:
    """Open up to `count` connections, and send `sent` on each."""
    connections = []
    for _ in range(count):
        with suppress(OSError):
            connection = target.dial()
            connection.settimeout(1.0)
            send_all(connection, sent)
            connections.append(connection)
    return connections


def _begin_chunked(target: Target) -> socket.socket:
    connection = target.dial()
    headers = target.headers(Content_Type="image/jpeg", Transfer_Encoding="chunked")
    send_all(connection, b"POST /features HTTP/1.1\r\n" + headers + b"\r\n")
    return connection
