"""Attacks by costly requests, and on the identification of clients.

Each is limited in count, stays on this machine, and returns the connections that it leaves open.
"""

import base64
import socket
import zlib
from contextlib import suppress
from functools import cache

import cv2
import numpy as np

from tests.serve.attacks.attacks import MANY, MB
from tests.serve.attacks.conftest import BINARY, Target, frame, read_head, send_all
from tests.serve.conftest import INFER, JPEG, jpeg, picture, png

BODY = 4 * MB  # the service's largest body
ANSWER_S = 10.0  # without an answer for this time, an attacker stops


def fill_bytes(target: Target, count: int = 8) -> list[socket.socket]:
    """JPEG files that consist of fill bytes."""
    return _ask(target, target.post(b"\xff\xd8" + b"\xff" * (BODY - 2)), count)


def stuffed_scans(target: Target, count: int = 8) -> list[socket.socket]:
    """JPEG files whose scan continues with stuffed bytes."""
    body = JPEG[:-2] + b"\xff\x00" * ((BODY - len(JPEG)) // 2)
    return _ask(target, target.post(body), count)


def repeated_outputs(target: Target, count: int = 8) -> list[socket.socket]:
    """Inference requests that request one output 250,000 times."""
    head = b'{"inputs":[{"name":"pixels","shape":[1,2,2,3],"datatype":"UINT8","data":[1]}],'
    part, end = b'{"name":"std"},', b'{"name":"std"}]}'
    body = head + b'"outputs":[' + part * ((BODY - 200) // len(part)) + end
    return _ask(target, target.post(body, INFER, Content_Type="application/json"), count)


def nested_inputs(target: Target, count: int = 8) -> list[socket.socket]:
    """Inference requests with millions of lists, nested or in sequence."""
    head = b'{"inputs":[{"name":"pixels","shape":[1,2,2,3],"datatype":"UINT8","data":'
    connections = []
    for body in (head + b"[" * (BODY - 200), head + b"[" + b"[]," * (BODY // 4) + b"0]}]}"):
        whole = target.post(body, INFER, Content_Type="application/json")
        connections += _ask(target, whole, count // 2)
    return connections


def encoded_garbage(target: Target, count: int = 8) -> list[socket.socket]:
    """Inference requests with 3 MB of base64 that is not an image."""
    data = base64.b64encode(bytes(3 * MB - 3000))
    tensor = b'{"name":"image","shape":[1,1],"datatype":"BYTES","data":[["%b"]]}' % data
    body = b'{"inputs":[%b]}' % tensor
    return _ask(target, target.post(body, INFER, Content_Type="application/json"), count)


def costly_images(target: Target, count: int = 4) -> list[socket.socket]:
    """PNG files of 65 KB with a decoding time of 0.7 s each."""
    sent = target.post(_costly_png(), Content_Type="image/png", X_Camera_Fov_Y="90")
    return [found for _ in range(count) for found in _ask(target, sent, 1)]


def chunky_images(target: Target, count: int = 64) -> list[socket.socket]:
    """Small PNG files with thousands of empty chunks."""
    body = png(picture())
    chunk = bytes(4) + b"tEXt" + zlib.crc32(b"tEXt").to_bytes(4, "big")
    body = body[:33] + chunk * 9_000 + body[33:]
    return _ask(target, target.post(body, Content_Type="image/png"), count)


def long_accepts(target: Target, count: int = 200) -> list[socket.socket]:
    """Requests whose Accept headers have 30,000 entries and differ from each other."""
    connections: list[socket.socket] = []
    for number in range(count):
        accept = "," * (30_000 - number) + "x/y"
        connections += _ask(target, target.post(JPEG, Accept=accept), 1)
    return connections


def many_costly_images(target: Target, count: int = 64) -> list[socket.socket]:
    """The images of `costly_images` on many connections at once, each as a separate stream."""
    connections = []
    for number in range(count):
        sent = target.post(
            _costly_png(), Content_Type="image/png", X_Camera_Fov_Y="90", X_Stream_Id=f"s{number}"
        )
        connections += _send(target, sent)
    return connections


def large_photographs(target: Target, count: int = 16) -> list[socket.socket]:
    """JPEG files of 12 megapixels."""
    return _ask(target, target.post(_photograph(), X_Camera_Fov_Y="67.5"), count)


def large_bodies(target: Target, count: int = MANY) -> list[socket.socket]:
    """Images and inference requests of 4 MB whose last byte is withheld."""
    connections = []
    for number in range(count):
        sent = target.post(bytes(BODY), ("/features", INFER)[number % 2])[:-1]
        connections += _send(target, sent)
    return connections


def half_messages(target: Target, count: int = MANY) -> list[socket.socket]:
    """WebSockets that withhold the last byte of a message of the largest size."""
    sent, connections = frame(BINARY, bytes(BODY - 64))[:-1], []
    for _ in range(count):
        with suppress(OSError, AssertionError):
            connection = target.open_websocket()
            connection.settimeout(1.0)
            send_all(connection, sent)
            connections.append(connection)
    return connections


def promised_bodies(target: Target, count: int = MANY) -> list[socket.socket]:
    """Headers that announce a body of 4 MB, which is never sent."""
    sent = target.post(b"", Content_Length=str(BODY))
    return [found for _ in range(count) for found in _send(target, sent)]


def rebound_names(target: Target, count: int = 200) -> list[socket.socket]:
    """Requests with a host name of the attacker, and from pages of other sites."""
    pages = {"Origin": "http://evil.example", "Content_Type": "text/plain"}
    for sent in (target.post(JPEG, Host="evil.example"), target.post(JPEG, INFER, **pages)):
        _ask(target, sent, count // 2)
    return []


def guessed_tokens(target: Target, count: int = 400) -> list[socket.socket]:
    """Requests with wrong tokens, for paths that need a token."""
    connections = []
    for number in range(count // 100):
        sent = target.post(JPEG[:100], Authorization=f"Bearer {number:032x}")
        connections += _ask(target, sent, 100)
    return connections


def forged_addresses(target: Target, count: int = 400) -> list[socket.socket]:
    """Requests with a different client in each X-Forwarded-For."""
    for number in range(count):
        client = f"10.{number % 256}.{number // 256}.1, ::{number:x}, unknown"
        _ask(target, target.post(JPEG[:100], X_Forwarded_For=client), 1)
    return []


def conflicting_lengths(target: Target, count: int = 40) -> list[socket.socket]:
    """Requests with an ambiguous length and another request in their body."""
    inner = target.ask(path="/model")
    pairs = [
        {"Content_Length": str(len(inner) + 5), "Transfer_Encoding": "chunked"},
        {"Transfer_Encoding": "chunked, identity"},
        {"Transfer_Encoding": " chunked"},
        {"Content_Length": f"+{len(inner)}"},
        {"Content_Length": f"{len(inner)}, 5"},
    ]
    connections = []
    for headers in pairs:
        for _ in range(count // len(pairs)):
            connections += _send(target, target.post(b"0\r\n\r\n" + inner, **headers))
    return connections


def unread_pages(target: Target, count: int = 16) -> list[socket.socket]:
    """Clients that repeatedly request the largest page, and read no answers."""
    connections = []
    for _ in range(count):
        for connection in _send(target, b""):
            connection.settimeout(0.05)
            send_all(connection, target.ask(path="/openapi.json"), 100)
            connections.append(connection)
    return connections


def half_closed(target: Target, count: int = MANY) -> list[socket.socket]:
    """Clients that shut down their sending side in the middle of a request, and wait."""
    connections = []
    for _ in range(count):
        for connection in _send(target, target.post(JPEG)[:-10]):
            with suppress(OSError):
                connection.shutdown(socket.SHUT_WR)
            connections.append(connection)
    return connections


def reset_requests(target: Target, count: int = 200) -> list[socket.socket]:
    """Clients that reset the connection after they have sent their image."""
    for _ in range(count):
        for connection in _send(target, target.post(JPEG)):
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, bytes([1, *bytes(7)]))
            connection.close()
    return []


REQUESTS = (
    *(fill_bytes, stuffed_scans, repeated_outputs, nested_inputs, encoded_garbage),
    *(costly_images, chunky_images, long_accepts, many_costly_images),
    *(large_photographs, large_bodies, half_messages),
    *(promised_bodies, unread_pages, half_closed, reset_requests),
    *(rebound_names, guessed_tokens, forged_addresses, conflicting_lengths),
)


@cache
def _costly_png() -> bytes:
    pixels = np.zeros((2048, 4096, 4), np.uint16)
    return png(pixels, cv2.IMWRITE_PNG_COMPRESSION, 9)


@cache
def _photograph() -> bytes:
    return jpeg(picture(4000, 3000))


def _send(target: Target, sent: bytes) -> list[socket.socket]:
    """A connection on which `sent` was sent; an empty list if the service accepts none."""
    try:
        connection = target.dial()
    except OSError:
        return []
    connection.settimeout(1.0)
    if sent:
        send_all(connection, sent)
    return [connection]


def _ask(target: Target, sent: bytes, count: int) -> list[socket.socket]:
    """Send the request `count` times on one connection, each time after the previous answer."""
    for connection in _send(target, b""):
        connection.settimeout(ANSWER_S)
        for _ in range(count):
            try:
                connection.sendall(sent)
                head = read_head(connection)
                size = int(head.lower().partition(b"content-length: ")[2].split(b"\r\n")[0])
                while size > 0 and (part := connection.recv(size)):
                    size -= len(part)
            except (OSError, ValueError, IndexError):
                break
        return [connection]
    return []
