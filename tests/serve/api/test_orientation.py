"""Every endpoint first turns an image upright according to its EXIF orientation."""

import json

import numpy as np
import pytest
from websockets.sync.client import connect

from tests.mtlnet.inference.images import exif, in_jpeg, in_png, picture
from tests.serve.conftest import (
    INFER,
    PATIENCE_S,
    FakeEngine,
    Served,
    tensor_request,
)

WIDE = picture(480, 210)


def stored_png(orientation: int) -> bytes:
    """A PNG file of `WIDE`, stored on its side (orientation 6, 8) or upside down (3)."""
    turns = {3: 2, 6: 1, 8: -1}
    return in_png(np.rot90(WIDE, turns[orientation]), exif(orientation))


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
    reply = service.post(in_jpeg(picture(), exif(6)))
    assert (reply.status, reply.content["type"]) == (422, "/problems/image-aspect")
    assert reply.content["detail"].startswith("the image is 210 x 280 px")
