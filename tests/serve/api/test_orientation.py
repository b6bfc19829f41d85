"""Every endpoint first turns an image upright according to its EXIF orientation."""

import json
import struct
import zlib

import numpy as np
import pytest
from websockets.sync.client import connect

from tests.serve.conftest import (
    INFER,
    PATIENCE_S,
    FakeEngine,
    Served,
    jpeg,
    picture,
    png,
    tensor_request,
)

WIDE = picture(480, 210)


def exif(orientation: int) -> bytes:
    return b"MM" + struct.pack(">HIHHHIHHI", 42, 8, 1, 0x0112, 3, 1, orientation, 0, 0)


def stored_png(orientation: int) -> bytes:
    """A PNG file of `WIDE`, stored on its side (orientation 6, 8) or upside down (3)."""
    turns = {3: 2, 6: 1, 8: -1}
    body = png(np.ascontiguousarray(np.rot90(WIDE, turns[orientation])[:, :, ::-1]))
    chunk = b"eXIf" + exif(orientation)
    chunk = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return body[:33] + chunk + body[33:]


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_endpoints_see_the_upright_image(
    orientation: int, service: Served, engine: FakeEngine
) -> None:
    """`crop_px` refers to the upright image, too."""
    body = stored_png(orientation)
    reply = service.post(body, "image/png")
    assert (reply.status, reply.content["crop_px"]) == (200, [100, 0, 280, 210])
    with connect(f"ws://127.0.0.1:{service.port}/stream", open_timeout=PATIENCE_S) as socket:
        socket.send(body)
        assert json.loads(socket.recv(PATIENCE_S))["crop_px"] == [100, 0, 280, 210]
    headers, request = tensor_request(body)
    assert service.ask("POST", INFER, request, headers).status == 200
    for image in engine.images[-3:]:
        assert np.array_equal(image, WIDE[:, 100:380])


def test_a_jpeg_that_stands_on_its_side_is_refused_by_its_upright_size(service: Served) -> None:
    block = b"Exif\0\0" + exif(6)
    body = jpeg(picture())
    body = body[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + body[2:]
    reply = service.post(body)
    assert (reply.status, reply.content["type"]) == (422, "/problems/image-aspect")
    assert reply.content["detail"].startswith("the image is 210 x 280 px")
