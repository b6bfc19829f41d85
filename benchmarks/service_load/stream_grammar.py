"""Generates random byte streams of HTTP/1.1 and WebSocket clients by a grammar. The streams are
valid or invalid.

Sources: RFC 9112 (messages, chunked coding), RFC 9110 (fields), RFC 6455 (handshakes, frames).
"""

import random

from tests.serve.attacks.conftest import frame
from tests.serve.conftest import JPEG

METHODS = (b"POST", b"GET", b"HEAD", b"PUT", b"OPTIONS", b"DELETE", b"CONNECT", b"PRI", b"X")
TARGETS = (
    *(b"/features", b"/stream", b"/v2/models/track/infer", b"/healthz", b"/metrics", b"/model"),
    *(b"/", b"*", b"http://localhost/features", b"/features?fov_y=%ff", b"//features/..", b"/\xff"),
)
VERSIONS = (b"HTTP/1.1", b"HTTP/1.0", b"HTTP/2.0", b"HTTP/1.12", b"http/1.1", b"")
ENDS = (b"\r\n", b"\n", b"\r", b"\r\n ", b" \r\n")
HOSTS = (b"localhost", b"127.0.0.1:80", b"[::1]", b"evil.example", b"[", b"", b"a" * 300)
TYPES = (b"image/jpeg", b"image/png", b"application/json", b"text/plain", b"", b"*/*;q=x")
SIZES = (b"0", b"5", b"-1", b"+5", b"5, 5", b"5, 6", b"0x5", b"9" * 30, b"0" * 5000 + b"5")
CODINGS = (
    b"chunked",
    b"Chunked",
    b"identity",
    b"chunked, chunked",
    b"gzip, chunked",
    b"\x0bchunked",
)
UPGRADES = (b"websocket", b"h2c", b"WebSocket", b"websocket, h2c", b"TLS/1.0")
OTHERS = (
    (b"Origin", (b"http://localhost", b"null", b"http://[", b"http://evil.example")),
    (b"Expect", (b"100-continue", b"200-ok")),
    (b"X-Forwarded-For", (b"10.0.0.1", b"unknown, ::1", b",,,")),
    (b"X-Stream-Id", (b"a", b"\xc3\xa9", b"a" * 200)),
    (b"X-Deadline-Ms", (b"100", b"-1", b"nan", b"1e400", b"0" * 5000)),
    (b"X-Camera-Fov-Y", (b"67.5", b"0", b"\xd9\xa1")),
    (b"Accept", (b"application/msgpack", b"text/html", b"*/*;q=0.5, */*;q=x")),
    (b"Inference-Header-Content-Length", (b"2", b"0" * 5000, b"999999")),
    (b"Authorization", (b"Bearer x", b"Basic eDp5", b"Bearer")),
    (b"Cookie", (b"a=b", b"x" * 9000)),
    (b"Connection", (b"close", b"keep-alive", b"upgrade", b"close, Upgrade, x")),
    (b" Folded", (b"a\r\n b",)),
    (b"", (b"no name",)),
)
BODIES = (
    b"",
    b"{}",
    b"hello",
    JPEG[:500],
    JPEG,
    b"[" * 500,
    b'{"inputs":[]}',
    b"\x89PNG" + bytes(90),
)
CODES = (b"", b"\x03", b"\x03\xe8", b"\x03\xe8bye", b"\x00\x00", b"\xff\xff", b"\x03\xe8\xff")
PAYLOADS = (*CODES, b"{}", b'{"frame_id": 1}', b"[" * 300, b"\xff\xfe", b"x" * 126, JPEG[:600])


def message(rng: random.Random) -> bytes:
    """Return a random HTTP/1.1 request or WebSocket handshake. Each of its parts is usually
    valid."""
    method = METHODS[0] if rng.random() < 0.5 else rng.choice(METHODS)
    version = VERSIONS[0] if rng.random() < 0.8 else rng.choice(VERSIONS)
    fields, body = [(b"Host", mostly(rng, HOSTS))], b""
    if rng.random() < 0.2:
        fields += handshake_fields(rng)
    else:
        coded, body = payload(rng)
        fields += [(b"Content-Type", rng.choice(TYPES)), *coded]
    for name, values in rng.sample(OTHERS, rng.randrange(4)):
        fields.append((name, rng.choice(values)))
    if rng.random() < 0.1:
        fields.append(rng.choice(fields))
    lines = [b" ".join([method, rng.choice(TARGETS), version])]
    lines += [name + rng.choice([b": ", b": ", b":", b" : "]) + value for name, value in fields]
    return b"".join(line + ending(rng) for line in [*lines, b""]) + body


def payload(rng: random.Random) -> tuple[list[tuple[bytes, bytes]], bytes]:
    """Return the Content-Length or Transfer-Encoding fields of a random body, which are sometimes
    wrong, and this body."""
    body = rng.choice(BODIES)
    length = (b"Content-Length", b"%d" % len(body) if rng.random() < 0.7 else rng.choice(SIZES))
    kind = rng.random()
    if kind < 0.4:
        return [length], body
    coding = (b"Transfer-Encoding", mostly(rng, CODINGS))
    return [coding] if kind < 0.9 else [coding, length], chunked(rng, body)


def chunked(rng: random.Random, body: bytes) -> bytes:
    """Return `body` in chunked transfer coding, with random chunk sizes, extensions and
    trailers."""
    sent, at = b"", 0
    while at < len(body):
        part = body[at : at + rng.choice([1, 7, 500])]
        size = b"%x" % len(part) if rng.random() < 0.97 else rng.choice(SIZES)
        extension = rng.choice([b"", b"", b";a=b", b';a="', b";" + b"x" * 400])
        sent += size + extension + ending(rng) + part + ending(rng)
        at += len(part)
    trailers = rng.choice(
        [b"", b"", b"X-T: 1\r\n", b"Authorization: Bearer x\r\n", b"X: y\r\n" * 90]
    )
    return sent + b"0" + ending(rng) + trailers + ending(rng)


def handshake_fields(rng: random.Random) -> list[tuple[bytes, bytes]]:
    """Return the header fields of a WebSocket handshake, usually valid and complete."""
    key = mostly(rng, (b"AAAAAAAAAAAAAAAAAAAAAA==", b"short", b"=" * 24, b"A" * 9000))
    fields = [
        (b"Connection", mostly(rng, (b"Upgrade", b"keep-alive, upgrade", b"close"))),
        (b"Upgrade", mostly(rng, UPGRADES)),
        (b"Sec-WebSocket-Version", mostly(rng, (b"13", b"8", b"13, 8", b""))),
        (b"Sec-WebSocket-Key", key),
        (b"Sec-WebSocket-Protocol", mostly(rng, (b"driverview.msgpack", b"a, a", b",", b"\x80"))),
        (b"Sec-WebSocket-Extensions", mostly(rng, (b"permessage-deflate", b"x;y=", b";"))),
    ]
    return [found for found in fields if rng.random() < 0.95]


def frames(rng: random.Random) -> bytes:
    """Return one to five random WebSocket frames, usually valid."""
    sent = b""
    for _ in range(rng.randrange(1, 6)):
        opcode = rng.choice([1, 2, 2, 0, 8, 9, 10, rng.randrange(16)])
        whole = bytearray(frame(opcode, rng.choice(PAYLOADS), rng.random() < 0.8))
        if rng.random() < 0.1:
            whole[0] |= rng.choice([0x40, 0x20, 0x10])  # reserved bits
        if rng.random() < 0.1:
            whole[1] &= 0x7F  # not masked
        if rng.random() < 0.05:
            whole[1:2] = b"\xff" + rng.choice([b"\xff" * 8, bytes(7) + b"\x01"])
        sent += whole
    return sent


def mostly(rng: random.Random, choices: tuple[bytes, ...]) -> bytes:
    """Return the first of the `choices` with probability 0.8, else a random one of all choices."""
    return choices[0] if rng.random() < 0.8 else rng.choice(choices)


def ending(rng: random.Random) -> bytes:
    """Return a line end: CR LF, or rarely an invalid line end."""
    return ENDS[0] if rng.random() < 0.99 else rng.choice(ENDS)
