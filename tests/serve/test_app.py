"""The service over HTTP: its answers, its problems, its readiness, and how it bears a crowd."""

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.model_card import ModelError, golden_image
from serve.api.problems import PROBLEM_TYPES
from serve.api.schemas import Features
from serve.config import MAX_BODY_BYTES
from serve.scheduling.warmup import warm_up
from tests.serve.conftest import (
    CARD,
    FakeEngine,
    Reply,
    Served,
    jpeg,
    outputs,
    picture,
    png,
    serving,
)

JPEG, PNG = jpeg(picture()), png(picture())


def assert_problem(reply: Reply, status: int, name: str) -> None:
    assert reply.status == status
    assert reply.headers["content-type"] == "application/problem+json"
    content = reply.content
    hint = {"retry_after_ms"} if status in (429, 503) else set()
    assert set(content) == {"type", "title", "status", "detail"} | hint
    assert content["type"] == f"/problems/{name}"
    assert content["status"] == status
    assert content["title"] == next(k.title for k in PROBLEM_TYPES if k.name == name)
    assert len(content["detail"]) > 20
    assert "Traceback" not in content["detail"]


def test_the_answer_is_what_the_engine_said(service: Served) -> None:
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
def test_the_answer_comes_in_the_type_that_is_accepted(
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


def test_what_cannot_be_given_is_not_acceptable(service: Served) -> None:
    for accept in ("text/html", "application/json;q=0", "application/json;q=x"):
        assert_problem(service.post(JPEG, Accept=accept), 406, "not-acceptable")


def test_a_wider_view_is_cropped_and_said_so(service: Served, engine: FakeEngine) -> None:
    wide = picture(480, 210)
    body = png(wide[:, :, ::-1])
    assert service.post(body, "image/png").content["crop_px"] == [100, 0, 280, 210]
    assert np.array_equal(engine.images[-1], wide[:, 100:380])
    assert service.post(JPEG).content["crop_px"] is None
    reply = service.post(JPEG, X_Camera_Fov_Y="90")
    assert reply.content["crop_px"] == [46, 35, 187, 140]
    assert_problem(service.post(JPEG, X_Camera_Fov_Y="60"), 422, "field-of-view")
    for text in ("nan", "0", "180", "wide", "1e999", ""):
        assert_problem(service.post(JPEG, X_Camera_Fov_Y=text), 422, "invalid-request")


def test_every_answer_names_its_request(service: Served) -> None:
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


def test_the_engine_sees_the_picture_that_was_sent(service: Served, engine: FakeEngine) -> None:
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
def test_bad_input_is_a_problem(
    service: Served, engine: FakeEngine, body: bytes, kind: str | None, status: int, name: str
) -> None:
    assert_problem(service.post(body, kind), status, name)
    assert not engine.images
    assert service.post(JPEG).status == 200  # on the same connection


def test_a_body_without_a_stated_length_meets_the_same_limit(service: Served) -> None:
    def endless() -> Iterator[bytes]:
        for _ in range(80):
            yield bytes(65536)

    assert_problem(service.post(endless()), 413, "body-too-large")


def test_a_compressed_body_and_a_strange_frame_id_are_refused(service: Served) -> None:
    assert_problem(service.post(JPEG, Content_Encoding="gzip"), 415, "unsupported-media-type")
    assert_problem(service.post(JPEG, X_Frame_Id="x" * 129), 422, "invalid-request")
    assert_problem(service.post(JPEG, X_Frame_Id="\xe9"), 422, "invalid-request")


def test_the_frameworks_own_errors_are_problems(service: Served) -> None:
    assert_problem(service.ask("GET", "/nothing"), 404, "not-found")
    reply = service.ask("GET", "/features")
    assert_problem(reply, 405, "method-not-allowed")
    assert reply.headers["allow"] == "POST"


def test_a_failing_engine_is_a_problem_without_our_insides(
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


def test_a_client_that_leaves_in_mid_upload_is_no_failure(
    service: Served, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(3):
        with socket.create_connection(("127.0.0.1", service.port)) as connection:
            head = "POST /features HTTP/1.1\r\nHost: x\r\nContent-Type: image/jpeg\r\n"
            connection.sendall(f"{head}Content-Length: {len(JPEG)}\r\n\r\n".encode() + JPEG[:99])
            time.sleep(0.05)
    time.sleep(0.2)
    assert service.post(JPEG).status == 200
    assert [record for record in caplog.records if record.levelname == "ERROR"] == []


@pytest.mark.slow
def test_mutated_images_never_break_it(service: Served) -> None:
    rng = np.random.default_rng(20)
    statuses = set()
    for number in range(3000):
        whole = bytearray((JPEG, PNG)[number % 2])
        for place in rng.integers(0, len(whole), rng.integers(1, 20)):
            whole[place] = rng.integers(256)
        if rng.random() < 0.3:  # the headers are the first hundred bytes
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


def test_not_ready_until_warm_but_alive() -> None:
    gate = threading.Event()
    engine = FakeEngine(lambda _image: outputs())
    with serving(engine, lambda _engine: gate.wait(120)) as service:
        assert service.ask("GET", "/healthz").content == {"status": "alive"}
        reply = service.ask("GET", "/readyz")
        assert_problem(reply, 503, "not-ready")
        assert reply.headers["retry-after"] == "1"
        assert_problem(service.post(JPEG), 503, "not-ready")
        gate.set()
        while service.ask("GET", "/readyz").status != 200:
            time.sleep(0.01)
        assert service.ask("GET", "/readyz").content["model"] == CARD.model_hash
        assert service.post(JPEG).status == 200


def always(answer: NDArray[np.float32]) -> FakeEngine:
    return FakeEngine(lambda _image: answer)


def test_never_ready_with_another_answer_than_the_published() -> None:
    right = np.array(CARD.golden, np.float32)
    engine = always(right)
    warm_up(engine)
    assert np.array_equal(engine.images[0], golden_image(280, 210))
    for wrong in (right + np.float32(0.01), right * np.float32(np.nan), right[:8]):
        with pytest.raises(ModelError):
            warm_up(always(wrong))
    rounded = always(right + np.float32(0.02))
    rounded.precision = "bf16"
    warm_up(rounded)
    rounded.respond = lambda _image: right + np.float32(0.04)
    with pytest.raises(ModelError, match=r"at most 0\.03 is expected in bf16"):
        warm_up(rounded)
    with serving(always(right + np.float32(0.01)), warm_up) as service:
        end = time.monotonic() + 60.0
        while "golden" not in (reply := service.ask("GET", "/readyz")).content["detail"]:
            assert_problem(reply, 503, "not-ready")  # it is still warming up
            assert time.monotonic() < end
        assert_problem(reply, 503, "not-ready")
        assert service.ask("GET", "/healthz").status == 200


def test_eight_clients_at_once_get_each_their_own_answer(
    service: Served, engine: FakeEngine
) -> None:
    """The angle is the picture's first pixel: an answer for another's picture would show."""
    engine.respond = lambda image: outputs(angle=int(image[0, 0, 0]) / 500)

    def drive(client: int) -> int:
        connection = Served(service.port)
        for frame in range(20):
            level = 10 * client + frame
            body = png(np.full((210, 280), level, np.uint8))
            while (reply := connection.post(body, "image/png")).status != 200:
                assert_problem(reply, 503, "overloaded")
                time.sleep(reply.content["retry_after_ms"] / 1e3)
            assert reply.content["angle_rad"] == pytest.approx(level / 500, abs=1e-5)
        return 20

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(drive, range(8))) == 160
    assert len(engine.images) == 160


def test_what_does_not_fit_the_queue_is_refused_at_once(
    service: Served, engine: FakeEngine
) -> None:
    """One frame in work and four waiting: of nine, five are answered and four are not."""
    gate = threading.Event()

    def respond(_image: Any) -> Any:
        gate.wait(120)
        return outputs()

    engine.respond = respond

    def post(_number: int) -> Reply:
        reply = Served(service.port).post(JPEG)
        if reply.status == 503:
            refusals.release()
        return reply

    refusals = threading.Semaphore(0)
    with ThreadPoolExecutor(9) as pool:
        replies = pool.map(post, range(9))
        try:
            for _ in range(4):
                assert refusals.acquire(timeout=60)
            assert service.ask("GET", "/healthz").status == 200  # the event loop is free
        finally:
            gate.set()
        found = list(replies)
    assert sorted(reply.status for reply in found) == [200] * 5 + [503] * 4
    for reply in found:
        if reply.status == 503:
            assert_problem(reply, 503, "overloaded")
            assert reply.headers["retry-after"] == "1"
    assert service.post(JPEG).status == 200


def test_the_model_page_and_the_docs(service: Served) -> None:
    model = service.ask("GET", "/model").content
    assert model["model"] == CARD.model_hash
    assert model["camera"]["fov_y_deg"] == 67.5
    page = service.ask("GET", "/")
    assert page.status == 200
    assert b"/features" in page.content
    assert service.ask("GET", "/docs").status == 200


def references(node: Any) -> Iterator[str]:
    if isinstance(node, dict):
        if isinstance(node.get("$ref"), str):
            yield node["$ref"]
        node = list(node.values())
    if isinstance(node, list):
        for child in node:
            yield from references(child)


def test_the_openapi_document_says_what_the_service_does(service: Served) -> None:
    document = service.ask("GET", "/openapi.json").content
    assert document["openapi"].startswith("3.1")
    for reference in references(document):
        node = document
        for key in reference.removeprefix("#/").split("/"):
            node = node[key]
        assert node
    assert set(document["paths"]) == {
        "/features",
        "/healthz",
        "/readyz",
        "/model",
        "/metrics",
        "/v2",
        "/v2/health/live",
        "/v2/health/ready",
        "/v2/models/track",
        "/v2/models/track/ready",
        "/v2/models/track/infer",
    }
    post = document["paths"]["/features"]["post"]
    assert post["requestBody"]["required"]
    assert set(post["requestBody"]["content"]) == {"image/jpeg", "image/png"}
    refused = {"400", "401", "406", "408", "413", "415", "422", "429", "431", "500", "503"}
    assert set(post["responses"]) == {"200"} | refused
    for status, response in post["responses"].items():
        good = {"application/json", "application/msgpack"}
        kinds = good if status == "200" else {"application/problem+json"}
        assert set(response["content"]) == kinds
    assert "HTTPValidationError" not in document["components"]["schemas"]
    kinds = document["components"]["schemas"]["ProblemDetails"]["properties"]["type"]["enum"]
    assert "/problems/not-an-image" in kinds


def test_the_service_imports_neither_torch_nor_physics() -> None:
    code = (
        "import sys, serve.app, serve.launch, serve.client; "
        "print(sorted({m.split('.')[0] for m in sys.modules} & "
        "{'torch', 'pybullet', 'simulator', 'datagen', 'numba', 'moderngl', 'mcap'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
