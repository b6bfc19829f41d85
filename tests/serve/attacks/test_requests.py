"""Requests that are costly for their size: time of the event loop and the engine, memory."""

import http.client
import socket
import threading
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import cv2
import numpy as np
import pytest

from mtlnet.inference.image_decoding.decode import (
    LATE_CHECK_BYTES,
    MAX_SCANNED_PX,
    PNG_NS_PER_BIT,
    PNG_NS_PER_BYTE,
    crop_and_resize,
    decode_whole,
    read_header,
)
from mtlnet.inference.image_decoding.errors import ImageError
from mtlnet.inference.image_decoding.jpeg_structure import (
    END_OF_DATA,
    ENDS_DATA,
    FIRST_BYTES,
    WINDOW_BYTES,
    read_structure,
)
from serve.api.features import SMALL_MS
from serve.api.request_options import MAX_ACCEPT, negotiate
from serve.config import MAX_BODY_BYTES, Limits
from serve.problems import Problem
from serve.scheduling.body_budget import BodyBudget, BodyShare
from serve.scheduling.fair_queue import PRESENT_NS, FairQueue
from serve.scheduling.overload import MAX_CLIENT_MS, MAX_PENDING_MS, Admission
from serve.shared_memory import create_shared_memory
from tests.serve.attacks.conftest import Target
from tests.serve.attacks.loop_time import LOOP_S, held_s
from tests.serve.conftest import (
    CARD,
    INFER,
    JPEG,
    PATIENCE_S,
    FakeEngine,
    Gate,
    Served,
    assert_problem,
    busy,
    jpeg,
    picture,
    png,
    serving,
    until,
)


def with_chunks(body: bytes, chunk: bytes, count: int) -> bytes:
    """A PNG with `count` ancillary chunks of the content `chunk` after its header."""
    whole = len(chunk).to_bytes(4, "big") + b"teXt" + chunk
    whole += zlib.crc32(whole[4:]).to_bytes(4, "big")
    return body[:33] + whole * count + body[33:]


def test_a_png_of_many_chunks_is_refused_and_its_bytes_have_a_cost() -> None:
    small = png(picture())
    body = with_chunks(small, b"", 300)
    with pytest.raises(ImageError, match=r"the PNG has over \d+ chunks"):
        decode_whole(body, read_header(body))
    padded = with_chunks(small, bytes(1000), 1000)
    header = read_header(padded)
    assert crop_and_resize(decode_whole(padded, header), CARD.camera).shape == (210, 280, 3)
    more_ms = header.decode_ms - read_header(small).decode_ms
    assert more_ms == pytest.approx(2e-6 * (len(padded) - len(small)), rel=1e-6)


@pytest.mark.alone
def test_no_png_that_is_decoded_on_the_event_loop_holds_it() -> None:
    pixels = png(picture(640, 480))
    chunks = (SMALL_MS * 1e6 - 640 * 480 * 24 * PNG_NS_PER_BIT) / PNG_NS_PER_BYTE - len(pixels)
    body = with_chunks(pixels, bytes(1012), int(chunks / 1024))
    header = read_header(body)
    assert SMALL_MS - 0.1 < header.decode_ms <= SMALL_MS
    assert held_s(lambda: crop_and_resize(decode_whole(body, header), CARD.camera)) < LOOP_S


def test_a_long_accept_header_is_refused_unread(service: Served) -> None:
    assert_problem(service.post(JPEG, Accept="," * (MAX_ACCEPT + 1)), 422, "invalid-request")
    assert held_s(lambda: negotiate("," * (MAX_ACCEPT - 8) + "text/css")) < LOOP_S / 4


@pytest.mark.parametrize("size", [FIRST_BYTES, FIRST_BYTES + WINDOW_BYTES, 2 * WINDOW_BYTES])
@pytest.mark.parametrize("beyond", range(-4, 4))
def test_a_marker_across_two_windows_is_found(size: int, beyond: int) -> None:
    at = size + beyond
    head = b"\xff\xd8\xff\xda\x00\x02"
    for data in (b"\x00", b"\xff"):
        body = head + data * at + b"\xff\xd9"
        found = read_structure(body)
        assert (found.length, found.scans) == (len(body), 1)


def test_both_searches_agree_on_what_ends_entropy_coded_data() -> None:
    found = [END_OF_DATA.match(bytes((0xFF, code))) is not None for code in range(256)]
    assert found == ENDS_DATA.tolist()


def test_scans_times_pixels_are_limited() -> None:
    body = jpeg(np.full((2040, 4080, 3), 90, np.uint8))
    assert read_header(body).scans == 1
    many = MAX_SCANNED_PX // (2040 * 4080) + 1
    repeated = body[:-2] + b"\xff\xda\x00\x02" * many + body[-2:]
    assert len(repeated) < WINDOW_BYTES
    with pytest.raises(ImageError, match="scans of 4080 x 2040 px"):
        read_header(repeated)


def test_a_full_queue_reads_no_inference_request() -> None:
    with busy(limits=Limits(queue=0)) as (service, _), Target(service.port).dial() as connection:
        # The body is not sent.
        connection.sendall(Target(service.port).post(b"", INFER, Content_Length="1000000"))
        assert connection.recv(65536).startswith(b"HTTP/1.1 503")


LARGE = png(np.zeros((2048, 4096, 4), np.uint16), cv2.IMWRITE_PNG_COMPRESSION, 9)


def post_from(address: str, service: Served, body: bytes) -> tuple[int, bytes]:
    """The status and body of the answer to an image, sent from the loopback address `address`."""
    with closing(
        http.client.HTTPConnection(
            "127.0.0.1", service.port, timeout=PATIENCE_S, source_address=(address, 0)
        )
    ) as connection:
        headers = {"Content-Type": "image/png", "X-Camera-Fov-Y": "90"}
        connection.request("POST", "/features", body, headers)
        response = connection.getresponse()
        return response.status, response.read()


def test_a_client_has_one_large_image_at_a_time() -> None:
    assert len(LARGE) < 100_000
    assert read_header(LARGE).decode_ms > 500
    gate = Gate()
    with serving(gate.engine) as service, ThreadPoolExecutor(2) as pool:
        first = pool.submit(post_from, "127.0.0.2", service, LARGE)
        until(gate.busy.is_set)
        status, body = post_from("127.0.0.2", service, LARGE)
        assert status == 503
        assert b"/problems/overloaded" in body
        assert b"of this client" in body
        assert post_from("127.0.0.3", service, LARGE)[0] == 503  # all clients: 1.4 s > 1 s
        small = pool.submit(Served(service.port).post, JPEG)
        until(lambda: service.app.frame_queue.waiting == 1)
        gate.open.set()
        assert first.result()[0] == 200
        assert small.result().status == 200
        assert post_from("127.0.0.4", service, LARGE)[0] == 503  # others are still present
        until(lambda: post_from("127.0.0.4", service, LARGE)[0] == 200)


def test_shares_of_the_engine() -> None:
    waiting, now = FairQueue(), 10**12
    admission = Admission(waiting)
    for _ in range(20):  # a client that is alone has no limit
        waiting.note("a", now)
        admission.admit("a", 700.0, now)()
        now += 700_000_000
    waiting.note("b", now)
    waiting.note("a", now)
    with pytest.raises(Problem, match="would take 700 ms"):  # b's frames would overflow the queue
        admission.admit("a", 700.0, now)
    with pytest.raises(Problem, match="beyond this client's share") as caught:
        admission.admit("a", 100.0, now)
    assert caught.value.retry_after_ms == pytest.approx((700 - 0.25 * 700) / 0.25)
    admission.admit("b", 100.0, now)()  # b has not used its share
    later = now + PRESENT_NS
    waiting.note("a", later)
    admission.admit("a", 700.0, later)()  # alone again

    full = Admission(FairQueue())
    done = [
        full.admit(f"c{n}", MAX_CLIENT_MS, now) for n in range(int(MAX_PENDING_MS // MAX_CLIENT_MS))
    ]
    with pytest.raises(Problem, match="of all clients"):
        full.admit("d", 40.0, now)
    with pytest.raises(Problem, match="of this client"):
        full.admit("c0", 40.0, now)
    done[0]()
    full.admit("d", 40.0, now)


def test_the_shares_of_many_addresses_are_bounded() -> None:
    admission = Admission(FairQueue())
    for number in range(3000):
        admission.admit(str(number), 100.0, number)()
    assert len(admission._credit) <= 1024
    assert not admission._client_ms


def test_a_refused_image_of_a_stream_gives_its_admission_back() -> None:
    with busy(limits=Limits(queue=0)) as (service, gate):
        sent = {"X_Stream_Id": "cam", "X_Camera_Fov_Y": "90"}
        for _ in range(3):
            reply = service.post(LARGE, "image/png", **sent)
            assert_problem(reply, 503, "overloaded")
            assert "frames are waiting" in reply.content["detail"]
        gate.open.set()
        until(lambda: service.post(LARGE, "image/png", **sent).status == 200)


def begin(service: Served, size: int, path: str = "/features") -> socket.socket:
    """A connection on which `size` bytes of a body of the largest size were sent."""
    target = Target(service.port)
    connection = target.dial()
    connection.sendall(target.post(bytes(size), path, Content_Length=str(MAX_BODY_BYTES)))
    return connection


@pytest.mark.parametrize("path", ["/features", INFER])
def test_bodies_in_flight_share_a_budget(engine: FakeEngine, path: str) -> None:
    mib = 1 << 20
    with serving(engine, limits=Limits(body_mib=8)) as service:
        bodies = service.app.bodies
        held = [begin(service, 3 * mib, path) for _ in range(2)]
        until(lambda: bodies.held == 6 * mib)
        assert service.post(JPEG).status == 200
        with begin(service, 3 * mib, path) as refused:
            assert refused.recv(65536).startswith(b"HTTP/1.1 503")
        until(lambda: bodies.held == 6 * mib)
        for connection in held:  # the clients disconnect in the middle of a body
            connection.close()
        until(lambda: bodies.held == 0)
        assert service.post(JPEG).status == 200
        assert_problem(service.post(b"\0" * 3 * mib), 422, "not-an-image")
        assert service.ask("POST", INFER, b"\0" * 3 * mib).status == 422
        assert bodies.held == 0


def test_workers_share_the_budget() -> None:
    shared = create_shared_memory(2)
    one, other = (BodyBudget(shared, block, 1000) for block in range(2))
    share = BodyShare(one)
    share.grow(600)
    with pytest.raises(Problem, match="bodies in flight"):
        BodyShare(other).grow(500)
    assert other.held == 0
    share.close()
    share.close()
    BodyShare(other).grow(500)
    assert (one.held, other.held) == (0, 500)
    assert BodyBudget(shared, 1, 1000).held == 0  # a new worker in the other's block
    BodyShare(one).grow(900)


def test_many_large_bodies_at_once_hold_no_more_than_the_budget() -> None:
    gate = Gate()
    with serving(gate.engine, limits=Limits(body_mib=8, queue=64)) as service:
        most = 0
        threads = [
            threading.Thread(target=post_from, args=(f"127.0.1.{n}", service, b"\0" * 4_000_000))
            for n in range(1, 11)
        ]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            most = max(most, service.app.bodies.held)
            time.sleep(0.001)
        assert 0 <= most <= 8 << 20
        assert service.app.bodies.held == 0
        gate.open.set()


def test_the_scans_of_a_large_file_are_checked_when_it_is_decoded() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (720, 960, 3), np.uint8)
    done, progressive = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    assert done
    for body, scans in ((jpeg(noise), 1), (progressive.tobytes(), 10)):
        assert len(body) > LATE_CHECK_BYTES
        header = read_header(body)
        assert (header.checked, header.scans) == (False, scans)
        assert crop_and_resize(decode_whole(body, header), CARD.camera).shape == (210, 280, 3)
        with pytest.raises(ImageError, match="follow the end of the image"):
            decode_whole(body + b"x" * 100, header)
        with pytest.raises(ImageError, match="before its end marker"):
            decode_whole(body[:-2], header)
    body = jpeg(noise)
    many = body[:-2] + b"\xff\xda\x00\x02" * 4 + body[-2:]
    with pytest.raises(ImageError, match="5 scans, a sequential one has 4"):
        decode_whole(many, read_header(many))
