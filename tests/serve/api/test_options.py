"""The options of an image are the same for every endpoint, and no option is ignored."""

import json
from collections.abc import Sequence
from typing import Any

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from tests.serve.conftest import INFER, PATIENCE_S, Reply, Served, jpeg, picture, tensor_request

WIDE = jpeg(picture(400, 300))
HEADERS = {
    "frame_id": "X-Frame-Id",
    "stream_id": "X-Stream-Id",
    "deadline_ms": "X-Deadline-Ms",
    "fov_y": "X-Camera-Fov-Y",
    "camera": "X-Camera",
}
Pairs = Sequence[tuple[str, str]]


def features(service: Served, query: str = "", headers: Pairs = ()) -> Reply:
    """POST /features; a name can occur twice in `headers`."""
    return post(service, f"/features{query}", WIDE, [("Content-Type", "image/jpeg"), *headers])


def infer(service: Served, query: str = "", headers: Pairs = (), **parameters: Any) -> Reply:
    """An inference request with the image as binary data."""
    length, body = tensor_request(WIDE, **({"parameters": parameters} if parameters else {}))
    return post(service, INFER + query, body, [*length.items(), *headers])


def post(service: Served, path: str, body: bytes, headers: Pairs) -> Reply:
    connection = service._connection
    connection.putrequest("POST", path)
    for name, value in (("Content-Length", str(len(body))), *headers):
        connection.putheader(name, value)
    connection.endheaders(body)
    response = connection.getresponse()
    return Reply(response.status, dict(response.headers), json.loads(response.read()))


def frame_id(reply: Reply) -> Any:
    return reply.content.get("parameters", reply.content).get("frame_id")


def stream(service: Served, query: str = "", text: str | None = None) -> Any:
    """The answer to an image on a WebSocket, or the problem in the reply to the handshake."""
    url = f"ws://127.0.0.1:{service.port}/stream{query}"
    try:
        with connect(url, open_timeout=PATIENCE_S, compression=None) as websocket:
            if text is not None:
                websocket.send(text)
            websocket.send(WIDE)
            return json.loads(websocket.recv(PATIENCE_S))
    except InvalidStatus as error:
        return json.loads(error.response.body or b"")


def test_a_header_the_query_and_parameters_say_the_same(service: Served) -> None:
    for ask in (features, infer):
        assert frame_id(ask(service, headers=[("X-Frame-Id", "a b")])) == "a b"
        assert frame_id(ask(service, "?frame_id=a%20b")) == "a b"
        assert ask(service, "?stream_id=cam&deadline_ms=60000").status == 200
        late = ask(service, "?deadline_ms=0")
        assert (late.status, late.content["type"]) == (503, "/problems/deadline-passed")
        narrow = ask(service, "?fov_y=20")
        assert (narrow.status, narrow.content["type"]) == (422, "/problems/field-of-view")
    assert features(service, "?fov_y=90").content["crop_px"] is not None
    assert frame_id(infer(service, frame_id=7)) == "7"
    assert infer(service, deadline_ms=0).content["type"] == "/problems/deadline-passed"
    assert infer(service, fov_y=20.5).content["type"] == "/problems/field-of-view"
    assert infer(service, stream_id="cam", deadline_ms="60000").status == 200


def test_a_websocket_takes_them_for_all_images_or_for_one(service: Served) -> None:
    assert stream(service, "?frame_id=x&stream_id=cam&deadline_ms=60000")["frame_id"] == "x"
    assert stream(service, "?fov_y=90")["crop_px"] is not None
    assert stream(service)["crop_px"] is None
    assert stream(service, "?fov_y=90", '{"fov_y": 67.5}')["crop_px"] is None
    assert stream(service, "", '{"fov_y": 90, "frame_id": "y"}')["crop_px"] is not None
    refused = stream(service, "", '{"frame_id": "z", "fov_y": 0}')
    assert (refused["type"], refused["frame_id"]) == ("/problems/invalid-request", "z")


@pytest.mark.parametrize(
    ("query", "seen"),
    [
        ("?fov=60", "'fov'; known are frame_id, stream_id, deadline_ms, fov_y, camera"),
        ("?Fov_Y=60", "'Fov_Y'"),
        ("?x-camera-fov-y=60", "'x-camera-fov-y'"),
        ("?deadline=5", "'deadline'"),
        ("?=5", "''"),
        ("?fov_y=60&fov_y=60", "'fov_y' occurs twice"),
        ("?fov_y=", "X-Camera-Fov-Y is ''"),
        ("?fov_y", "X-Camera-Fov-Y is ''"),
        ("?frame_id=", "X-Frame-Id has 0 characters"),
        ("?stream_id=", "X-Stream-Id has 0 characters"),
        ("?deadline_ms=1_000", "X-Deadline-Ms is '1_000'"),
        ("?deadline_ms=nan", "X-Deadline-Ms is 'nan'"),
        ("?deadline_ms=-1", "expected a number from 0 to 60000"),
        ("?deadline_ms=60001", "expected a number from 0 to 60000"),
        ("?deadline_ms=soon", "X-Deadline-Ms is 'soon'"),
        ("?deadline_ms=1%C3%A9", "X-Deadline-Ms"),
        ("?deadline_ms=", "X-Deadline-Ms is ''"),
        ("?fov_y=nan", "X-Camera-Fov-Y is 'nan'"),
        ("?fov_y=0", "expected a number from 1 to 179"),
        ("?fov_y=180", "expected a number from 1 to 179"),
        ("?fov_y=1e999", "X-Camera-Fov-Y is '1e999'"),
        ("?fov_y=%C3%A9", "X-Camera-Fov-Y"),
        ("?" + "&".join(["fov_y=1"] * 20), "more than 16 fields"),
    ],
)
def test_what_is_unknown_twice_or_empty_is_refused_everywhere(
    service: Served, query: str, seen: str
) -> None:
    for content in (
        features(service, query).content,
        infer(service, query).content,
        stream(service, query),
    ):
        assert (content["status"], content["type"]) == (422, "/problems/invalid-request")
        assert seen in content["detail"]


@pytest.mark.parametrize("name", HEADERS)
def test_a_header_that_is_sent_twice_or_beside_the_query_is_refused(
    service: Served, name: str
) -> None:
    header = HEADERS[name]
    for ask in (features, infer):
        for query, headers in (
            ("", [(header, "60"), (header, "60")]),
            ("", [(header, "60"), (header.lower(), "70")]),
            (f"?{name}=60", [(header, "60")]),
        ):
            reply = ask(service, query, headers)
            assert reply.status == 422
            assert header in reply.content["detail"]
        assert ask(service, "", [(header, "")]).status == 422
    parameters: dict[str, Any] = {name: 60}
    reply = infer(service, headers=[(header, "60")], **parameters)
    assert (reply.status, "parameters" in reply.content["detail"]) == (422, True)


@pytest.mark.parametrize(
    "name",
    ["X-Camera-Fov", "X-Camera-Fov-X", "X-Fov-Y", "fov_y", "Fov-Y", "X-Deadline", "Frame-Id"],
)
def test_a_misspelt_header_is_refused(service: Served, name: str) -> None:
    for ask in (features, infer):
        reply = ask(service, headers=[(name, "60")])
        assert (reply.status, reply.content["type"]) == (422, "/problems/invalid-request")
        assert f"unknown header {name.lower()!r}; known are X-Frame-Id" in reply.content["detail"]


def test_headers_of_clients_and_proxies_are_ignored(service: Served) -> None:
    names = ["X-Forwarded-For", "Forwarded", "X-Real-IP", "Via", "Cookie", "Range", "Priority"]
    for name in (*names, "traceparent", "X-Frame-Options", "X-Forwarded-Host", "If-None-Match"):
        for ask in (features, infer):
            assert ask(service, headers=[(name, "60"), (name, "60")]).status == 200


@pytest.mark.parametrize("name", [*HEADERS, "binary_data_output"])
def test_an_option_beside_the_parameters_is_refused(service: Served, name: str) -> None:
    tensor = {"name": "image", "shape": [1], "datatype": "BYTES", "data": ["AAAA"]}
    contents: list[Any] = [{"inputs": [tensor], name: 60}, {"inputs": [{**tensor, name: None}]}]
    for content in contents:
        reply = service.ask("POST", INFER, json.dumps(content).encode())
        assert reply.status == 422
        assert f"{name} is at the wrong place" in reply.content["error"]


def test_unknown_parameters_of_the_inference_protocol_are_refused(service: Served) -> None:
    known = "known are binary_data_output, frame_id, stream_id, deadline_ms, fov_y, camera"
    unknown: list[dict[str, Any]] = [{"sequence_id": 1}, {"timeout": 5}, {"Fov_Y": 60}]
    for one in unknown:
        reply = infer(service, **one)
        assert reply.status == 422
        assert known in reply.content["error"]
    wrongs: list[dict[str, Any]] = [{"fov_y": True}, {"fov_y": None}, {"deadline_ms": [1]}]
    for wrong in (*wrongs, {"frame_id": 1.5}):
        assert infer(service, **wrong).status == 422
    assert infer(service, binary_data_output="yes").status == 422
    image = {"name": "image", "shape": [1], "datatype": "BYTES", "data": ["AAAA"]}
    contents: list[tuple[Any, str]] = [
        ({"inputs": [{**image, "parameters": {"content_type": "np"}}]}, "binary_data_size")
    ]
    for more in ({"classification": 2}, {"binary_data": 1}):
        outputs = [{"name": "std", "parameters": more}]
        contents.append(({"inputs": [image], "outputs": outputs}, "binary_data"))
    for content, seen in contents:
        reply = service.ask("POST", INFER, json.dumps(content).encode())
        assert (reply.status, seen in reply.content["error"]) == (422, True)
    twice = b'{"inputs":[%b],"parameters":{"fov_y":60,"fov_y":70}}' % json.dumps(image).encode()
    assert "occurs twice" in service.ask("POST", INFER, twice).content["error"]


def test_text_messages_name_what_is_unknown(service: Served) -> None:
    for text, seen in (
        ('{"fov": 60}', "frame_id, deadline_ms, fov_y, camera"),
        ('{"stream_id": "a"}', "'stream_id'"),
        ('{"fov_y": 60, "fov_y": 70}', "occurs twice"),
        ('{"deadline_ms": true}', "must be a number"),
        ('{"frame_id": ""}', "0 characters"),
    ):
        content = stream(service, "", text)
        assert content["status"] == 422
        assert seen in content["detail"]


def test_an_inference_answer_is_json_or_tensors(service: Served) -> None:
    for accept in ("*/*", "application/json", "application/octet-stream", "text/html, */*;q=0.1"):
        assert infer(service, headers=[("Accept", accept)]).status == 200
    for accept in ("application/msgpack", "text/html", "application/json;q=0"):
        reply = infer(service, headers=[("Accept", accept)])
        assert (reply.status, reply.content["type"]) == (406, "/problems/not-acceptable")
        assert "application/octet-stream" in reply.content["error"]
