"""Bodies at their limits, sent to a running service: none blocks its event loop for LOOP_S.

The time includes parsing, joining of parts, checks, and decoding if the loop does it.
"""

import base64
import socket
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest

from mtlnet.inference.image_decoding.jpeg_structure import WINDOW_BYTES
from serve.config import MAX_BODY_BYTES
from serve.server.websocket import SMALL_BYTES
from tests.serve.attacks.conftest import BINARY, CONTINUATION, Target, frame
from tests.serve.attacks.loop_time import LOOP_S, least_s, watched
from tests.serve.conftest import INFER, JPEG, PNG, Served, serving

pytestmark = pytest.mark.alone
ROOM = MAX_BODY_BYTES - len(JPEG)


def segment(marker: int, content: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, len(content) + 2) + content


def with_segments(data: bytes) -> bytes:
    """A JPEG with `data` after its first marker."""
    return JPEG[:2] + data + JPEG[2:]


def in_scan(data: bytes, size: int = MAX_BODY_BYTES) -> bytes:
    """A JPEG whose scan is followed by repeated `data`, of up to `size` bytes in total."""
    return JPEG[:-2] + data * ((size - len(JPEG)) // len(data)) + JPEG[-2:]


def with_chunk(kind: bytes, content: bytes, count: int = 1) -> bytes:
    """A PNG with `count` additional chunks after its header."""
    whole = struct.pack(">I", len(content)) + kind + content
    return PNG[:33] + (whole + struct.pack(">I", zlib.crc32(whole[4:]))) * count + PNG[33:]


def tables(marker: int, count: int) -> bytes:
    """The tables of a JPEG, repeated in `count` segments."""
    at = JPEG.index(bytes([0xFF, marker])) + 2
    table = JPEG[at + 2 : at + int.from_bytes(JPEG[at : at + 2], "big")]
    return segment(marker, table * (65_000 // len(table))) * count


def profile(count: int = 62) -> bytes:
    """A colour profile in `count` parts, which the decoder joins."""
    each = (b"ICC_PROFILE\0" + bytes([k + 1, count]) + bytes(65_000) for k in range(count))
    return b"".join(segment(0xE2, part) for part in each)


IMAGES: dict[str, bytes] = {
    "fill between segments": with_segments(
        (b"\xff" * (ROOM // 500 - 8) + segment(0xE1, b"")) * 500
    ),
    "restart markers": in_scan(b"\xff\xd0"),
    "fill in the scan": in_scan(b"\xff"),
    "stuffed": in_scan(b"\xff\x00"),
    "stuffed window": in_scan(b"\xff\x00", WINDOW_BYTES),
    "fill in a window": in_scan(b"\xff", WINDOW_BYTES),
    "fill": b"\xff\xd8" + b"\xff" * (MAX_BODY_BYTES - 2),
    "fill behind the first marker": with_segments(b"\xff" * ROOM),
    "comments": with_segments(b"\xff\xfe\x00\x02" * (ROOM // 4)),
    "profile": with_segments(profile()),
    "Huffman tables": with_segments(tables(0xC4, 62)),
    "quantisation tables": with_segments(tables(0xDB, 62)),
    "Exif": with_segments(segment(0xE1, b"Exif\0\0MM\0*" + bytes(65_000)) * 62),
    "text": with_chunk(b"tEXt", b"k\0" + bytes(65_000), 60),
    "chunks": with_chunk(b"teXt", bytes(1000), 3900),
    "compressed text": with_chunk(b"zTXt", b"k\0\0" + zlib.compress(bytes(50 << 20)), 40),
    "compressed profile": with_chunk(b"iCCP", b"k\0\0" + zlib.compress(bytes(4 << 20))),
    "pixels after the last": PNG[:33] + with_chunk(b"IDAT", bytes(ROOM - 99_999))[33:],
}


@pytest.fixture(scope="module")
def fast() -> Iterator[Served]:
    """A service with an immediate engine, so that small images are decoded on the event loop."""
    with serving() as service:
        for _ in range(12):
            assert service.post(JPEG).status == 200
        yield service


def holds_s(service: Served, connect: Callable[[], socket.socket], sent: bytes) -> float:
    """The longest time in s for which the bytes `sent` on a connection block the event loop."""

    def once() -> float:
        with connect() as connection, watched(service) as watch:
            with suppress(ConnectionError):  # the service refuses it before it is complete
                connection.sendall(sent)
            with suppress(ConnectionError):
                connection.recv(1)  # the answer has begun
        return watch.longest_s

    return least_s(once, at_least=1)


@pytest.mark.parametrize("name", IMAGES)
def test_no_image_holds_the_loop(fast: Served, name: str) -> None:
    target, body = Target(fast.port), IMAGES[name]
    large = MAX_BODY_BYTES * 0.4 < len(body) <= MAX_BODY_BYTES
    assert large or "window" in name or body.startswith(b"\x89PNG")
    kind = "image/png" if body.startswith(b"\x89PNG") else "image/jpeg"
    assert holds_s(fast, target.dial, target.post(body, Content_Type=kind)) < LOOP_S


@pytest.mark.parametrize("path", ["/features", INFER])
@pytest.mark.parametrize("sizes", [[1] * 500 + [513] * 7000, [513] * 7000, [1025] * 3900])
def test_no_chunks_hold_the_loop(fast: Served, path: str, sizes: list[int]) -> None:
    target = Target(fast.port)
    head = target.post(b"", path, Transfer_Encoding="chunked")
    head = head.replace(b"Content-Length: 0\r\n", b"")
    body = b"".join(b"%x\r\n%b\r\n" % (size, b"x" * size) for size in sizes)
    assert holds_s(fast, target.dial, head + body + b"0\r\n\r\n") < LOOP_S


@pytest.mark.parametrize(
    "text",
    [
        b"\\/" * 2_000_000,
        b"\\u0041" * 690_000,
        base64.b64encode(bytes(3_000_000)),
        b"\xc3\xa9" * 10**6,
    ],
    ids=["slashes", "escapes", "base64", "letters"],
)
def test_no_string_holds_the_loop(fast: Served, text: bytes) -> None:
    target = Target(fast.port)
    tensor = b'{"inputs":[{"name":"image","shape":[1],"datatype":"BYTES","data":["%b"]}]}' % text
    assert holds_s(fast, target.dial, target.post(tensor, INFER)) < LOOP_S


@pytest.mark.parametrize(
    "sizes", [[65_000] * 62, [SMALL_BYTES] * 2000, [SMALL_BYTES - 1] * 2000, [1] * 50_000]
)
def test_no_fragments_hold_the_loop(fast: Served, sizes: list[int]) -> None:
    frames = [frame(CONTINUATION, bytes(size), fin=False) for size in sizes]
    frames[0] = frame(BINARY, bytes(sizes[0]), fin=False)
    sent = b"".join(frames) + frame(CONTINUATION)
    assert holds_s(fast, Target(fast.port).open_websocket, sent) < LOOP_S


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/features?" + "a=1&" * 8000, {}),
        ("/features?fov_y=" + "%41" * 10_000, {}),
        ("/" + "%41" * 10_000, {}),
        ("/features", {f"X-{number}": "" for number in range(3000)}),
        ("/features", {"Accept": "," * 1000 + "x/y"}),
    ],
    ids=["fields", "escapes", "path", "headers", "accept"],
)
def test_no_head_holds_the_loop(fast: Served, path: str, headers: dict[str, str]) -> None:
    target = Target(fast.port)
    assert holds_s(fast, target.dial, target.post(JPEG, path, **headers)) < LOOP_S
