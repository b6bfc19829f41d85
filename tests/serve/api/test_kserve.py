"""The Open Inference Protocol v2, tested with requests built from its specification."""

import base64
import json
import struct
from typing import Any

import numpy as np
import pytest

from serve.config import Limits
from tests.serve.attacks.conftest import Target, read_reply
from tests.serve.conftest import (
    INFER,
    JPEG,
    FakeEngine,
    Reply,
    Served,
    busy,
    constant_engine,
    picture,
    serving,
)


def infer(
    service: Served, content: Any, binary: bytes | None = None, path: str = INFER, **headers: str
) -> Reply:
    head = json.dumps(content).encode()
    if binary is None:
        return service.ask("POST", path, head, headers)
    length = {"Inference-Header-Content-Length": str(len(head))}
    return service.ask("POST", path, head + binary, {**length, **headers})


def image(**more: Any) -> dict[str, Any]:
    return {"name": "image", "shape": [1, 1], "datatype": "BYTES", **more}


def pixels(shape: list[int], data: list[Any]) -> dict[str, Any]:
    return {"name": "pixels", "shape": shape, "datatype": "UINT8", "data": data}


RAW = struct.pack("<I", len(JPEG)) + JPEG
BINARY = {"inputs": [image(parameters={"binary_data_size": len(RAW)})]}
BASE64 = image(data=[base64.b64encode(JPEG).decode()])


def test_health_and_metadata(service: Served) -> None:
    for path in ("/v2/health/live", "/v2/health/ready", "/v2/models/track/ready"):
        assert service.ask("GET", path).status == 200
    assert "binary_tensor_data" in service.ask("GET", "/v2").content["extensions"]
    model = service.ask("GET", "/v2/models/track").content
    assert model == service.ask("GET", "/v2/models/track/versions/1").content
    assert {tensor["name"] for tensor in model["inputs"]} == {"image", "pixels"}
    assert service.ask("GET", "/v2/health/ready").content == {"ready": True}
    for path in ("/v2/models/track/ready", "/v2/models/track/versions/1/ready"):
        assert service.ask("GET", path).content == {"name": "track", "ready": True}


def test_not_ready_before_the_model_is_warm() -> None:
    def fail(_engine: Any) -> None:
        raise RuntimeError

    with serving(constant_engine(), fail) as service:
        assert service.ask("GET", "/v2/health/live").status == 200
        for path in ("/v2/health/ready", "/v2/models/track/ready"):
            assert service.ask("GET", path).status == 503


def test_json_in_and_out_is_what_features_says(service: Served) -> None:
    expected = service.post(JPEG).content
    answer = infer(service, {"id": "7", "inputs": [BASE64]}).content
    assert (answer["id"], answer["model_name"], answer["model_version"]) == ("7", "track", "1")
    assert answer["parameters"]["model"] == expected["model"]
    found = {output["name"]: output for output in answer["outputs"]}
    assert all(output["datatype"] == "FP32" for output in answer["outputs"])
    assert found["distances_m"]["shape"] == [1, 5]
    assert found["distances_m"]["data"][2:] == [None] * 3


def test_raw_binary_in_and_out(service: Served, engine: FakeEngine) -> None:
    wanted = [
        {"name": "angle_rad", "parameters": {"binary_data": True}},
        {"name": "heading"},
        {"name": "distances_m", "parameters": {"binary_data": True}},
    ]
    reply = infer(service, {**BINARY, "outputs": wanted})
    assert reply.status == 422  # the binary part is missing
    reply = infer(service, {**BINARY, "outputs": wanted}, RAW)
    length = int(reply.headers["inference-header-content-length"])
    head = json.loads(reply.content[:length])
    assert [output["name"] for output in head["outputs"]] == ["angle_rad", "heading", "distances_m"]
    values = np.frombuffer(reply.content[length:], "<f4")
    assert values == pytest.approx([0.1, -2, 2, np.nan, np.nan, np.nan], abs=1e-5, nan_ok=True)
    everything = infer(service, {**BINARY, "parameters": {"binary_data_output": True}}, RAW)
    length = int(everything.headers["inference-header-content-length"])
    assert len(everything.content) - length == 4 * 23

    sent = picture()
    tensor = {"name": "pixels", "shape": [1, 210, 280, 3], "datatype": "UINT8"}
    raw = {"inputs": [{**tensor, "parameters": {"binary_data_size": sent.size}}]}
    assert infer(service, raw, sent.tobytes()).status == 200
    assert np.array_equal(engine.images[-1], sent)
    plain = {"inputs": [pixels([1, 210, 280, 3], sent.tolist())]}
    assert infer(service, plain, path="/v2/models/track/versions/1/infer").status == 200
    assert np.array_equal(engine.images[-1], sent)


@pytest.mark.parametrize("accept", ["application/json", "application/octet-stream", "*/*"])
def test_parameters_and_not_accept_select_the_type_of_the_answer(
    service: Served, accept: str
) -> None:
    for binary, expected in ((True, "application/octet-stream"), (False, "application/json")):
        outputs = [{"name": "heading", "parameters": {"binary_data": binary}}]
        reply = infer(service, {"inputs": [BASE64], "outputs": outputs}, Accept=accept)
        assert (reply.status, reply.headers["content-type"]) == (200, expected)
        assert ("inference-header-content-length" in reply.headers) == binary
    described = service.ask("GET", "/openapi.json").content["paths"][INFER]["post"]["responses"]
    assert "`Accept` does not select the type" in described["200"]["description"]


@pytest.mark.parametrize(
    ("content", "binary", "name"),
    [
        ([], None, "invalid-request"),
        ({"inputs": []}, None, "invalid-request"),
        ({"inputs": [BASE64, BASE64]}, None, "invalid-request"),
        ({"inputs": [image(data=["%%%"])]}, None, "invalid-request"),
        ({"inputs": [image(data=[1])]}, None, "invalid-request"),
        ({"inputs": [{**BASE64, "shape": [2]}]}, None, "invalid-request"),
        ({"inputs": [{**BASE64, "name": "other"}]}, None, "invalid-request"),
        ({"inputs": [BASE64], "outputs": [{"name": "other"}]}, None, "invalid-request"),
        ({"inputs": [BASE64]}, b"more", "invalid-request"),
        (BINARY, RAW[:-1], "invalid-request"),
        (BINARY, b"\xff" * len(RAW), "invalid-request"),
        ({"inputs": [image(data=["aGVsbG8="])]}, None, "not-an-image"),
        ({"inputs": [pixels([24, 32, 3], [0])]}, None, "invalid-request"),
        ({"inputs": [pixels([0, 2, 3], [])]}, None, "invalid-request"),
        ({"inputs": [pixels([24, 32, 3], [256] * 2304)]}, None, "invalid-request"),
        ({"inputs": [pixels([2, 2, 3], [[0] * 12])]}, None, "image-size"),
    ],
)
def test_what_breaks_the_protocol_is_a_problem_with_its_error(
    service: Served, content: Any, binary: bytes | None, name: str
) -> None:
    reply = infer(service, content, binary)
    assert reply.status == 422
    assert reply.content["type"] == f"/problems/{name}"
    assert reply.content["error"] == reply.content["detail"]
    assert infer(service, {"inputs": [BASE64]}).status == 200


def test_a_wrong_header_length_and_deep_nesting_are_refused(service: Served) -> None:
    for length in ("99999999", "-1", "x", "1" * 5000, "0" * 5000, "0" * 21, "9" * 20):
        headers = {"Inference-Header-Content-Length": length}
        assert service.ask("POST", INFER, b"{}", headers).status == 422
    deep = b"[" * 900 + b"]" * 900
    head = b'{"inputs": [{"name": "pixels", "shape": [1, 1, 3], "datatype": "UINT8", "data": '
    assert service.ask("POST", INFER, head + deep + b"}]}").status == 422
    assert service.ask("POST", INFER, head + b"[" * 100_000).status == 422


def post_raw(service: Served, *lines: str, path: str = INFER) -> dict[str, Any]:
    """The JSON reply to a request with these header lines and without a body."""
    with Target(service.port).dial() as connection:
        text = "".join(f"{line}\r\n" for line in (f"POST {path} HTTP/1.1", *lines, ""))
        connection.sendall(text.encode("latin-1"))
        status, content = read_reply(connection)
        return {**content, "status": status}


HOST = "Host: localhost"


@pytest.mark.parametrize(
    ("status", "lines", "path"),
    [
        (404, [HOST, "Content-Length: 0"], "/v2/models/other/infer"),
        (404, [HOST, "Content-Length: 0"], "/v2/models/track/versions/2/infer"),
        (404, [HOST, "Content-Length: 0"], "/v2/repository/index"),
        (405, [HOST, "Content-Length: 0"], "/v2/health/live"),
        (405, [HOST, "Content-Length: 0"], "/v2"),
        (413, [HOST, "Content-Length: 99999999"], INFER),
        (415, [HOST, "Content-Length: 9", "Content-Encoding: gzip"], INFER),
        (422, [HOST, "Content-Length: 0"], INFER),
        (403, ["Host: evil.example", "Content-Length: 0"], INFER),
        (403, [HOST, "Origin: http://evil.example", "Content-Length: 0"], "/v2"),
        (400, [HOST, HOST, "Content-Length: 0"], INFER),
        (400, ["Content-Length: 0"], INFER),
        (400, [HOST, "Content-Length: x"], INFER),
        (431, [HOST, "X-Long: " + 33_000 * "x"], INFER),
        (400, [HOST, "Transfer-Encoding: chunked", "", "zz"], INFER),
        (413, [HOST, "Transfer-Encoding: chunked", "", *["1", "x"] * 1000], INFER),
    ],
)
def test_every_error_below_v2_has_the_member_error(
    service: Served, status: int, lines: list[str], path: str
) -> None:
    content = post_raw(service, *lines, path=path)
    assert content["status"] == status
    assert content["error"] == content["detail"]
    assert "error" not in post_raw(service, *lines, path=path.replace("/v2", "/v3"))


def test_errors_below_v2_without_a_token_over_the_rate_or_when_full_have_it_too() -> None:
    engine = constant_engine()
    with serving(engine, limits=Limits(token="a-token-of-some-length")) as service:
        reply = service.ask("GET", "/v2")
        assert (reply.status, reply.content["error"]) == (401, reply.content["detail"])
    with serving(engine, limits=Limits(rate=1)) as service:
        other = {"X-Forwarded-For": "192.0.2.1"}
        assert service.ask("GET", "/v2", headers=other).status == 200
        reply = service.ask("GET", "/v2", headers=other)
        assert (reply.status, reply.content["error"]) == (429, reply.content["detail"])
    with serving(FakeEngine(lambda _image: 1 / 0)) as service:  # type: ignore[arg-type,return-value]
        reply = infer(service, {"inputs": [BASE64]})
        assert (reply.status, reply.content["error"]) == (500, reply.content["detail"])
    with busy(limits=Limits(queue=0)) as (service, _):
        reply = infer(service, {"inputs": [BASE64]})
        assert (reply.status, reply.content["error"]) == (503, reply.content["detail"])
