"""Attacks with the bodies of HTTP requests: trailers, chunks, uploads that end early."""

import gc
import logging
import socket
from collections.abc import Callable

import pytest

from serve.api.features import FeaturesRequest
from serve.config import MAX_HEAD_BYTES, Limits
from serve.server.connection import FREE_CHUNKS
from serve.server.fast_path import DirectRequest
from tests.serve.attacks import attacks
from tests.serve.attacks.conftest import (
    BINARY,
    Target,
    close,
    frame,
    open_count,
    read_head,
    read_reply,
    read_rest,
    resident_mb,
    status_of,
    uncollected,
)
from tests.serve.conftest import JPEG, Served, jpeg, picture, serving, until

MB = 1 << 20


TOKEN = "a-token-of-some-length"


@pytest.mark.parametrize(
    "attack",
    [attacks.endless_trailers, attacks.endless_trailer, attacks.endless_chunk_extension],
)
def test_trailers_count_as_headers(service: Served, target: Target, attack: attacks.Attack) -> None:
    before = resident_mb()
    (connection,) = attack(target)
    assert resident_mb() - before < 30
    assert b"/problems/headers-too-large" in read_rest(connection)
    assert service.post(JPEG).status == 200


def test_trailers_after_a_refusal_are_limited_too() -> None:
    with serving(limits=Limits(token=TOKEN)) as service:
        (connection,) = attacks.endless_trailers(Target(service.port))
        received = read_rest(connection)
        assert status_of(received) == 401
        assert b"/problems/headers-too-large" in received


def test_trailers_are_dropped() -> None:
    """With and without ASGI, a token or an address in a trailer has no effect."""
    with serving(limits=Limits(token=TOKEN)) as service:
        target = Target(service.port)
        body = b"%x\r\n%b\r\n0\r\n" % (len(JPEG), JPEG)
        trailers = b"Authorization: Bearer %b\r\nX-Forwarded-For: 10.0.0.1\r\n\r\n"
        for sent in ({}, {"Expect": "100-continue"}, {"X_Forwarded_For": "10.0.0.2"}):
            with target.dial() as connection:
                headers = target.headers(
                    Content_Type="image/jpeg", Transfer_Encoding="chunked", **sent
                )
                head = b"POST /features HTTP/1.1\r\n" + headers + b"\r\n"
                connection.sendall(head + body + trailers % TOKEN.encode())
                assert status_of(read_head(connection)) == 401
        with Target(service.port, TOKEN).dial() as connection:
            headers = Target(service.port, TOKEN).headers(
                Content_Type="image/jpeg", Transfer_Encoding="chunked"
            )
            head = b"POST /features HTTP/1.1\r\n" + headers + b"\r\n"
            for _ in range(2):
                connection.sendall(head + body + b"X-Small: 1\r\n\r\n")
                assert read_reply(connection)[0] == 200


def test_large_chunked_bodies_are_no_trailers(service: Served, target: Target) -> None:
    image = jpeg(picture(1120, 840)) + bytes(0)
    head = b"POST /features HTTP/1.1\r\n" + target.headers(
        Content_Type="image/jpeg", Transfer_Encoding="chunked"
    )
    parts = [image[at : at + 4] for at in range(0, len(image), 4)]
    body = b"".join(b"%x;%b\r\n%b\r\n" % (len(part), b"x" * 900, part) for part in parts)
    assert len(body) > 100 * MAX_HEAD_BYTES
    with target.dial() as connection:
        connection.sendall(head + b"\r\n" + body + b"0\r\n\r\n")
        assert read_reply(connection)[0] == 200


@pytest.mark.parametrize("attack", [attacks.left_uploads, attacks.refused_uploads])
def test_an_upload_that_ends_early_leaves_nothing(
    service: Served, target: Target, attack: Callable[[Target, int], list[socket.socket]]
) -> None:
    service.post(JPEG)
    close(attack(target, 5))
    until(lambda: open_count(service) == 1)
    with uncollected():
        close(attack(target, 40))
        until(lambda: open_count(service) == 1)
        assert service.post(JPEG).status == 200
        left = [o for o in gc.get_objects() if type(o) in (DirectRequest, FeaturesRequest)]
        assert len(left) <= 1  # of the connection above


@pytest.mark.parametrize("path", ["/features", "/stream"])
def test_a_refused_image_leaves_no_body_in_a_reference_cycle(
    service: Served, target: Target, path: str
) -> None:
    body = JPEG[:-2] + b"\xff\x00" * (1 << 20)  # the engine's thread refuses it
    with uncollected():
        if path == "/features":
            for _ in range(30):
                assert service.post(body).status == 422
        else:
            connection = target.open_websocket()
            for _ in range(30):
                connection.sendall(frame(BINARY, body))
                assert b"damaged" in connection.recv(1 << 16)
            close([connection])


def test_an_idle_connection_keeps_no_body(service: Served, target: Target) -> None:
    before = resident_mb()
    connections = [target.dial() for _ in range(30)]
    for connection in connections:
        connection.sendall(target.post(bytes(3 * MB)))
        assert read_reply(connection)[0] == 422
    until(lambda: resident_mb() - before < 30)
    assert open_count(service) == len(connections)
    close(connections)


def test_small_chunks_take_no_more_memory_than_their_bytes(target: Target) -> None:
    before = resident_mb()
    connections = attacks.small_chunks(target, 4)
    assert resident_mb() - before < 40
    close(connections)


def test_a_body_in_many_small_chunks_is_refused(service: Served, target: Target) -> None:
    head = b"POST /features HTTP/1.1\r\n" + target.headers(
        Content_Type="image/jpeg", Transfer_Encoding="chunked"
    )
    with target.dial() as connection:
        connection.sendall(head + b"\r\n" + b"2\r\nxy\r\n" * 2 * FREE_CHUNKS)
        received = read_rest(connection)
        assert received.startswith(b"HTTP/1.1 413")
        assert b"send larger ones" in received
    size = len(JPEG) // (FREE_CHUNKS - 1) + 1
    parts = [JPEG[at : at + size] for at in range(0, len(JPEG), size)]
    with target.dial() as connection:
        body = b"".join(b"%x\r\n%b\r\n" % (len(part), part) for part in parts)
        connection.sendall(head + b"\r\n" + body + b"0\r\n\r\n")
        assert read_reply(connection)[0] == 200
    assert 0.9 * FREE_CHUNKS < len(parts) < FREE_CHUNKS


@pytest.mark.parametrize("path", ["/features", "/v2/models/track/infer"])
def test_a_damaged_body_after_an_expectation_is_one_refusal(
    service: Served, target: Target, path: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The expected "100 Continue" must not follow the refusal; it once raised an error."""
    headers = {
        "Expect": "100-continue",
        "Content_Type": "application/json",
        "Transfer_Encoding": "chunked",
    }
    head = b"POST %b HTTP/1.1\r\n%b\r\n" % (path.encode(), target.headers(**headers))
    with target.dial() as connection:
        connection.sendall(head + b"no number\r\n")
        assert read_reply(connection)[0] == 400
        assert read_rest(connection) == b""
    assert service.ask("GET", "/healthz").status == 200  # the event loop still runs
    assert [record for record in caplog.records if record.levelno >= logging.ERROR] == []
