"""Frames over a WebSocket have the answers, the problems and the rules of POST /features."""

import asyncio
import json
import tracemalloc
from typing import Any

import msgspec
import pytest
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from serve.api.stream import Stream
from serve.app import Service
from serve.config import MAX_BODY_BYTES, Limits
from tests.serve.attacks.conftest import Target
from tests.serve.conftest import JPEG, PATIENCE_S, Gate, Served, constant_engine, serving, until


def dial(service: Served, path: str = "/stream", **options: Any) -> ClientConnection:
    url = f"ws://127.0.0.1:{service.port}{path}"
    socket: ClientConnection = connect(url, compression=None, open_timeout=PATIENCE_S, **options)
    return socket


def read(socket: ClientConnection) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(socket.recv(PATIENCE_S))
    return content


def test_each_frame_is_answered_as_over_http(service: Served) -> None:
    expected = service.post(JPEG).content
    with dial(service) as socket:
        for number in ("1", "2"):
            socket.send(JPEG)
            answer = read(socket)
            assert answer["frame_id"] == number
            assert set(answer) == set(expected)
            for name in set(expected) - {"timing_ms", "frame_id"}:
                assert answer[name] == expected[name]
        socket.send(b"no image")
        problem = read(socket)
        assert problem["type"] == "/problems/not-an-image"
        assert (problem["status"], problem["frame_id"]) == (422, "3")
        socket.send(json.dumps({"frame_id": "mine"}))
        socket.send(JPEG)
        assert read(socket)["frame_id"] == "mine"
        unusable = ("x" * 129, None, 1.5)
        names = [json.dumps({"frame_id": name}) for name in unusable]
        for text in ("[]", "{", '{"other": 1}', *names):
            socket.send(text)
            socket.send(JPEG)
            assert read(socket)["type"] == "/problems/invalid-request"
        socket.send(JPEG)
        assert read(socket)["frame_id"] == "11"


def test_an_image_after_two_text_messages_is_refused(service: Served) -> None:
    """The options of one of the two messages would be lost."""
    with dial(service) as socket:
        for texts in (['{"fov_y": 90}', '{"frame_id": "mine"}'], ["", '{"fov_y": 90}'], ["{}"] * 3):
            for text in texts:
                socket.send(text)
            socket.send(JPEG)
            problem = read(socket)
            assert problem["type"] == "/problems/invalid-request"
            assert "more than one text message" in problem["detail"]
        socket.send('{"frame_id": "mine"}')
        socket.send(JPEG)
        assert read(socket)["frame_id"] == "mine"


def test_messagepack_by_subprotocol_and_options_by_query(service: Served) -> None:
    protocol = Subprotocol("driverview.msgpack")
    with dial(service, "/stream?fov_y=90", subprotocols=[protocol]) as socket:
        assert socket.subprotocol == protocol
        socket.send(JPEG)
        answer = msgspec.msgpack.decode(socket.recv(PATIENCE_S, decode=False))
        assert answer["crop_px"] == [46, 35, 187, 140]


def test_a_newer_frame_replaces_a_queued_one_and_late_ones_are_dropped() -> None:
    gate = Gate()
    with serving(gate.engine) as service, dial(service) as socket, dial(service) as other:
        socket.send(JPEG)
        assert gate.busy.wait(PATIENCE_S)
        socket.send(JPEG)
        socket.send(JPEG)
        problem = read(socket)
        assert (problem["type"], problem["frame_id"]) == ("/problems/superseded", "2")
        other.send(json.dumps({"deadline_ms": 0}))
        other.send(JPEG)
        until(lambda: service.app.frame_queue.waiting == 2)
        gate.open.set()
        assert [read(socket)["frame_id"] for _ in range(2)] == ["1", "3"]
        assert read(other)["type"] == "/problems/deadline-passed"
    assert len(gate.engine.images) == 2


def test_a_refusal_at_the_handshake() -> None:
    with serving(limits=Limits(token="0123456789abcdef")) as service:
        token = {"Authorization": "Bearer 0123456789abcdef"}
        for path, headers, status, name in (
            ("/stream", {}, 401, "unauthorized"),
            ("/other", token, 404, "not-found"),
            ("/stream", {**token, "Origin": "https://evil.example"}, 403, "forbidden-origin"),
            ("/stream?deadline_ms=soon", token, 422, "invalid-request"),
            ("/stream?fov_y=0", token, 422, "invalid-request"),
        ):
            with pytest.raises(InvalidStatus) as caught:
                dial(service, path, additional_headers={**headers, "X-Request-Id": "mine"})
            response = caught.value.response
            assert response.status_code == status
            assert json.loads(response.body or b"")["type"] == f"/problems/{name}"
            assert response.headers["X-Request-Id"] == "mine"
        same = {**token, "Origin": service.url}
        with dial(service, additional_headers=same) as socket:
            socket.send(JPEG)
            assert read(socket)["frame_id"] == "1"


def test_a_message_that_is_too_long_closes_its_websocket_only(service: Served) -> None:
    with dial(service) as socket:

        def exchange() -> None:
            socket.send(bytes(MAX_BODY_BYTES + 1))  # this line or the next one raises
            socket.recv(PATIENCE_S)

        with pytest.raises(ConnectionClosedError) as caught:
            exchange()
        assert caught.value.rcvd is not None
        assert caught.value.rcvd.code == 1009
    assert service.post(JPEG).status == 200


def test_a_client_that_is_still_sending_receives_the_close_frame(service: Served) -> None:
    with Target(service.port).open_websocket() as connection:
        connection.sendall(b"\x82\xff" + (MAX_BODY_BYTES + 1).to_bytes(8, "big") + bytes(4))
        said = connection.recv(1)  # the service has refused the message as too long
        for _ in range(4):
            connection.sendall(bytes(1 << 18))
        said += b"".join(iter(lambda: connection.recv(65536), b""))
    assert said[:1] == b"\x88"
    assert int.from_bytes(said[2:4], "big") == 1009


def test_a_long_text_is_not_kept_while_the_websocket_is_idle() -> None:
    """A complete text is no longer counted in the memory budget for bodies."""
    held: list[int] = []
    service = Service(constant_engine())
    messages = iter(({"type": "websocket.connect"}, {"type": "websocket.receive"}))
    scope = {"headers": [], "path": "/stream", "query_string": b"", "subprotocols": []}

    async def receive() -> dict[str, Any]:
        message: dict[str, Any] | None = next(messages, None)
        if message is None:
            held.append(tracemalloc.get_traced_memory()[0])
            return {"type": "websocket.disconnect"}
        if message["type"] == "websocket.receive":
            message["text"] = "x" * MAX_BODY_BYTES
        return message

    async def send(_message: Any) -> None:
        pass

    tracemalloc.start()
    try:
        asyncio.run(Stream(service.frames, service.rate_limiter)(scope, receive, send))
    finally:
        tracemalloc.stop()
    assert held[0] < MAX_BODY_BYTES // 4


def test_websockets_with_the_same_request_id_are_two_streams() -> None:
    gate = Gate()
    sent = {"X-Request-Id": "same"}
    with (
        serving(gate.engine) as service,
        dial(service, additional_headers=sent) as one,
        dial(service, additional_headers=sent) as two,
    ):
        one.send(JPEG)
        until(gate.busy.is_set)
        one.send(JPEG)
        until(lambda: service.app.frame_queue.waiting == 1)
        two.send(JPEG)
        until(lambda: service.app.frame_queue.waiting == 2)
        gate.open.set()
        assert all("angle_rad" in read(socket) for socket in (one, one, two))
