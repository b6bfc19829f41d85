"""Attacks with WebSockets, limited like the attacks of `attacks`."""

import socket

from tests.serve.attacks.attacks import MANY, MB, Attack, dial_each
from tests.serve.attacks.conftest import BINARY, CONTINUATION, PING, TEXT, Target, frame, send_all
from tests.serve.conftest import JPEG


def frames_before_the_handshake(target: Target, count: int = 64) -> list[socket.socket]:
    """WebSocket frames in one segment with the handshake."""
    early = frame(PING) + frame(8, b"\x03\xe8")
    return dial_each(target, count, target.handshake() + early)


def unread_pings(target: Target, megabytes: int = 16) -> list[socket.socket]:
    """Pings of a client that does not read the pongs."""
    return _stream(target, frame(PING, bytes(125)), megabytes)


def large_unread_pings(target: Target, megabytes: int = 16) -> list[socket.socket]:
    """Pings between frames of a few hundred bytes, of a client that does not read the pongs."""
    part = frame(BINARY, bytes(300), fin=False) + frame(CONTINUATION, bytes(300))
    return _stream(target, part + frame(PING, bytes(125)), megabytes)


def empty_fragments(target: Target, megabytes: int = 16) -> list[socket.socket]:
    """One message of empty fragments."""
    connection = target.open_websocket()
    send_all(connection, frame(BINARY, fin=False))
    _pour(connection, frame(CONTINUATION, fin=False), megabytes)
    return [connection]


def small_messages(target: Target, megabytes: int = 16) -> list[socket.socket]:
    """Messages of one byte, which are all refused."""
    return _stream(target, frame(BINARY, b"x"), megabytes)


def deep_texts(target: Target, count: int = 50) -> list[socket.socket]:
    """Options with deeply nested JSON."""
    connection = target.open_websocket()
    for text in (b"[" * 900, b"[" * 4000, b'{"a":' * 200):
        send_all(connection, (frame(TEXT, text) + frame(BINARY, b"no image")), count)
    return [connection]


def long_texts(target: Target, count: int = 32) -> list[socket.socket]:
    """Texts of 4 MB that need four times as much memory after decoding."""
    text = "\N{AUTOMOBILE}".encode() + b"x" * (4 * MB - 100)
    return _send_on_each(target, count, frame(TEXT, text), wait_s=1.0)


def text_floods(target: Target, megabytes: int = 16) -> list[socket.socket]:
    """Texts of 2 KB, without an image."""
    return _stream(target, frame(TEXT, b"[" * 2048), megabytes)


def kept_messages(target: Target, count: int = 32) -> list[socket.socket]:
    """Messages of 4 MB from clients that do not read the answers to earlier messages."""
    connections = [target.open_websocket() for _ in range(count)]
    small, large = frame(BINARY, b"no image" * 128), frame(BINARY, bytes(4 * MB - 64))
    for connection in connections:
        connection.settimeout(0.2)
        sent = _send_until_full(connection, small * 2000)
        send_all(connection, small[sent % len(small) :] + large)  # completes the cut frame
    return connections


def broken_texts(target: Target, count: int = 50) -> list[socket.socket]:
    """A text that is not UTF-8, on each of many WebSockets."""
    return _send_on_each(target, count, frame(TEXT, b"\xff\xfe"))


def half_frames(target: Target, count: int = 32) -> list[socket.socket]:
    """WebSockets that withhold the last byte of a message of 1 MB."""
    return _send_on_each(target, count, frame(BINARY, bytes(MB))[:-1])


def unread_answers(target: Target, count: int = 16) -> list[socket.socket]:
    """WebSockets whose clients do not read the answers."""
    return _send_on_each(target, count, frame(BINARY, b"no image" * 128), 2000, wait_s=0.2)


def left_websockets(target: Target, count: int = 32) -> list[socket.socket]:
    """Clients that reset a WebSocket while their frames wait."""
    for _ in range(count):
        with target.open_websocket() as connection:
            send_all(connection, frame(BINARY, JPEG), 16)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, bytes([1, *bytes(7)]))
    return []


def quiet_websockets(target: Target, count: int = MANY) -> list[socket.socket]:
    """WebSockets without messages."""
    return [target.open_websocket() for _ in range(count)]


WEBSOCKETS: tuple[Attack, ...] = (
    *(frames_before_the_handshake, unread_pings, large_unread_pings, empty_fragments),
    *(small_messages, deep_texts, long_texts, text_floods, broken_texts, half_frames),
    *(unread_answers, kept_messages, left_websockets, quiet_websockets),
)


def _send_on_each(
    target: Target, count: int, sent: bytes, most: int = 1, wait_s: float | None = None
) -> list[socket.socket]:
    """WebSockets, on each of which `sent` is sent up to `most` times, waiting up to `wait_s`."""
    connections = [target.open_websocket() for _ in range(count)]
    for connection in connections:
        if wait_s is not None:
            connection.settimeout(wait_s)
        send_all(connection, sent, most)
    return connections


def _send_until_full(connection: socket.socket, data: bytes) -> int:
    """Send until the service stops reading; returns the number of bytes sent."""
    sent = 0
    try:
        while sent < len(data):
            sent += connection.send(data[sent : sent + (64 << 10)])
    except OSError:
        pass
    return sent


def _stream(target: Target, sent: bytes, megabytes: int) -> list[socket.socket]:
    connection = target.open_websocket()
    _pour(connection, sent, megabytes)
    return [connection]


def _pour(connection: socket.socket, sent: bytes, megabytes: int) -> None:
    """Send `sent` repeatedly, up to `megabytes`, or until the service stops reading."""
    connection.settimeout(1.0)
    part = sent * ((256 << 10) // len(sent))
    send_all(connection, part, 4 * megabytes)
