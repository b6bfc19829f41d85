"""POST /features over HTTP: the answer, its media type, the used part of the image, refusals."""

import json
import socket
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest

import trackfeatures as tf
from serve.api.schemas import Features
from serve.config import MAX_BODY_BYTES, Limits
from tests.serve.conftest import (
    CARD,
    JPEG,
    PNG,
    FakeEngine,
    Served,
    assert_problem,
    jpeg,
    outputs,
    picture,
    png,
    serving,
    until,
)


@pytest.mark.parametrize(("method", "path"), [("POST", "/features"), ("GET", "/model")])
def test_a_request_that_is_refused_early_keeps_its_id(method: str, path: str) -> None:
    with serving(limits=Limits(token="0123456789abcdef", rate=1.0)) as service:
        for headers, status in (
            ({}, 401),
            ({"Origin": "https://evil.example"}, 403),
            ({"X-Forwarded-For": "203.0.113.1"}, 401),
            ({"X-Forwarded-For": "203.0.113.1"}, 429),
        ):
            reply = service.ask(method, path, None, {**headers, "X-Request-Id": "mine"})
            assert (reply.status, reply.headers["x-request-id"]) == (status, "mine")
        assert service.ask(method, path).headers["x-request-id"]


def test_the_answer_holds_the_engines_outputs(service: Served) -> None:
    reply = service.post(JPEG, X_Frame_Id="frame 7")
    answer = reply.content
    assert reply.status == 200
    assert reply.headers["content-type"] == "application/json"
    assert answer["distances_m"] == pytest.approx(
        {"ml": -2.0, "mr": 2.0, "l": None, "m": None, "r": None}, abs=1e-5
    )
    assert answer["to_lane_centre_m"] == pytest.approx(0.0, abs=1e-5)
    assert answer["angle_rad"] == pytest.approx(0.1, abs=1e-6)
    assert answer["heading"] == pytest.approx({"left": 0.2, "straight": 0.5, "right": 0.3})
    assert answer["model"] == CARD.model_hash
    assert answer["definitions_version"] == tf.VERSION
    assert (answer["engine"], answer["precision"]) == ("fake", "f32")
    assert answer["frame_id"] == "frame 7"
    timing = answer["timing_ms"]
    assert 0 <= timing["decode"] <= timing["total"]
    assert 0 <= timing["forward"] <= timing["total"]
    Features.model_validate(answer, strict=True)
    assert set(answer) == set(Features.model_fields)


@pytest.mark.parametrize(
    ("accept", "kind"),
    [
        ("*/*", "application/json"),
        ("application/msgpack", "application/msgpack"),
        ("application/vnd.msgpack", "application/msgpack"),
        ("application/json;q=0.5, application/msgpack", "application/msgpack"),
        ("application/*;q=0.1, application/msgpack;q=0", "application/json"),
        ("text/html, */*;q=0.1", "application/json"),
    ],
)
def test_accept_selects_the_media_type_of_the_answer(
    service: Served, accept: str, kind: str
) -> None:
    reply = service.post(JPEG, Accept=accept)
    assert reply.headers["content-type"] == kind
    plain = service.post(JPEG).content
    read = msgspec.msgpack.decode if kind.endswith("msgpack") else lambda content: content
    answer = read(reply.content)
    for found in (answer, plain):
        del found["timing_ms"]
    assert answer == plain


def test_unavailable_media_types_are_not_acceptable(service: Served) -> None:
    for accept in ("text/html", "application/json;q=0", "application/json;q=x"):
        assert_problem(service.post(JPEG, Accept=accept), 406, "not-acceptable")


def test_a_wider_view_is_cropped_and_the_answer_gives_the_crop(
    service: Served, engine: FakeEngine
) -> None:
    wide = picture(480, 210)
    body = png(wide[:, :, ::-1])
    assert service.post(body, "image/png").content["crop_px"] == [100, 0, 280, 210]
    assert np.array_equal(engine.images[-1], wide[:, 100:380])
    assert service.post(JPEG).content["crop_px"] is None
    reply = service.post(JPEG, X_Camera_Fov_Y="90")
    assert reply.content["crop_px"] == [46, 35, 187, 140]
    assert_problem(service.post(JPEG, X_Camera_Fov_Y="60"), 422, "field-of-view")


def test_every_answer_has_a_request_id(service: Served) -> None:
    assert service.post(JPEG, X_Request_Id="mine 1").headers["x-request-id"] == "mine 1"
    found = [service.post(JPEG).headers["x-request-id"] for _ in range(3)]
    found.append(service.post(b"").headers["x-request-id"])
    found.append(service.post(JPEG, X_Request_Id="x" * 129).headers["x-request-id"])
    assert len(set(found)) == 5


def test_absent_markings_are_null(service: Served, engine: FakeEngine) -> None:
    engine.respond = lambda _image: outputs((np.nan,) * 5)
    answer = service.post(PNG, "image/png").content
    assert answer["distances_m"] == dict.fromkeys(tf.MARKINGS)
    assert answer["to_lane_centre_m"] is None
    assert answer["frame_id"] is None
    Features.model_validate(answer, strict=True)


def test_the_engine_gets_the_pixels_that_were_sent(service: Served, engine: FakeEngine) -> None:
    image = picture()
    assert service.post(png(image[:, :, ::-1]), "image/png; name=x").status == 200
    assert np.array_equal(engine.images[-1], image)


@pytest.mark.parametrize(
    ("body", "kind", "status", "name"),
    [
        (b"hello, I am text", "text/plain", 415, "unsupported-media-type"),
        (b"hello, I am text", "image/jpeg", 422, "not-an-image"),
        (JPEG, "application/octet-stream", 415, "unsupported-media-type"),
        (JPEG, None, 415, "unsupported-media-type"),
        (b"", "image/png", 422, "not-an-image"),
        (JPEG[:-100], "image/jpeg", 422, "damaged-image"),
        (jpeg(picture(100, 100)), "image/jpeg", 422, "image-aspect"),
        (JPEG + JPEG, "image/jpeg", 422, "trailing-bytes"),
        (jpeg(picture(8, 6)), "image/jpeg", 422, "image-size"),
        (bytes(MAX_BODY_BYTES + 1), "image/jpeg", 413, "body-too-large"),
    ],
)
def test_bad_input_is_answered_with_a_problem(
    service: Served, engine: FakeEngine, body: bytes, kind: str | None, status: int, name: str
) -> None:
    assert_problem(service.post(body, kind), status, name)
    assert not engine.images
    assert service.post(JPEG).status == 200  # the connection is still open


def test_a_body_without_content_length_has_the_same_limit(service: Served) -> None:
    def endless() -> Iterator[bytes]:
        for _ in range(80):
            yield bytes(65536)

    assert_problem(service.post(endless()), 413, "body-too-large")


def test_a_compressed_body_and_an_invalid_frame_id_are_refused(service: Served) -> None:
    assert_problem(service.post(JPEG, Content_Encoding="gzip"), 415, "unsupported-media-type")
    assert_problem(service.post(JPEG, X_Frame_Id="x" * 129), 422, "invalid-request")
    assert_problem(service.post(JPEG, X_Frame_Id="\xe9"), 422, "invalid-request")


def test_a_failing_engine_is_a_problem_that_does_not_reveal_the_exception(
    service: Served, engine: FakeEngine
) -> None:
    def fail(_image: Any) -> Any:
        raise RuntimeError("secret")

    engine.respond = fail
    reply = service.post(JPEG)
    assert_problem(reply, 500, "internal")
    assert "secret" not in json.dumps(reply.content)
    engine.respond = lambda _image: outputs()
    assert service.post(JPEG).status == 200


def test_a_client_that_disconnects_during_its_body_causes_no_error(
    service: Served, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(3):
        with socket.create_connection(("127.0.0.1", service.port)) as connection:
            head = "POST /features HTTP/1.1\r\nHost: localhost\r\nContent-Type: image/jpeg\r\n"
            begun = f"{head}Content-Length: {len(JPEG)}\r\n\r\n".encode() + JPEG[:99]
            connection.sendall(begun)
            service.wait_received(len(begun))
        until(lambda: not service.server.server_state.connections)
    assert service.post(JPEG).status == 200
    assert [record for record in caplog.records if record.levelname == "ERROR"] == []


@pytest.mark.slow
def test_mutated_images_are_answered_or_refused(service: Served) -> None:
    rng = np.random.default_rng(20)
    statuses = set()
    for number in range(3000):
        whole = bytearray((JPEG, PNG)[number % 2])
        for place in rng.integers(0, len(whole), rng.integers(1, 20)):
            whole[place] = rng.integers(256)
        if rng.random() < 0.3:  # the first hundred bytes are the headers
            whole[rng.integers(100)] ^= 1 << rng.integers(8)
        if rng.random() < 0.2:
            whole = whole[: rng.integers(len(whole))]
        if rng.random() < 0.1:
            whole += bytes(rng.integers(0, 256, 64, np.uint8))
        reply = service.post(bytes(whole), ("image/jpeg", "image/png")[number % 2])
        statuses.add(reply.status)
        if reply.status != 200:
            assert reply.headers["content-type"] == "application/problem+json"
    assert statuses == {200, 422}
    assert service.post(JPEG).status == 200
