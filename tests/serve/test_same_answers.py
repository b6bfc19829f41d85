"""Same image, same answer: by whichever worker, engine, type and way into the service."""

import base64
import http.client
import json
import signal
import struct
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from websockets.sync.client import connect

import trackfeatures as tf
from mtlnet.inference.engine import Engine, load_engine
from mtlnet.inference.image_decoding.decode import decode, inspect
from mtlnet.inference.model_card import golden_image
from mtlnet.inference.prediction import decode_outputs
from serve.client import Client
from serve.scheduling.warmup import TOLERANCE
from tests.serve.conftest import jpeg, picture, serving, until
from tests.serve.test_cli import address, started
from trackfeatures.camera import CameraParameters

JPEG = jpeg(picture())
INFER = "/v2/models/track/infer"
CONNECTIONS = 6
SAID = ("distances_m", "to_lane_centre_m", "angle_rad", "heading", "std", "out_of_distribution")
FROM = ("model", "engine", "precision", "definitions_version")

Connection = http.client.HTTPConnection


def post(connection: Connection, path: str, body: bytes, **headers: str) -> tuple[bytes, int]:
    """(the body of the answer, the length of its JSON part)."""
    sent = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request("POST", path, body, sent)
    response = connection.getresponse()
    content = response.read()
    assert response.status == 200, content
    return content, int(response.headers.get("Inference-Header-Content-Length", len(content)))


def by_json(connection: Connection, name: str) -> dict[str, Any]:
    content, _ = post(
        connection, "/features", JPEG, Content_Type="image/jpeg", X_Request_Id=f"{name}.json"
    )
    return dict(json.loads(content))


def by_messagepack(connection: Connection, name: str) -> dict[str, Any]:
    headers = {"Content_Type": "image/jpeg", "Accept": "application/msgpack"}
    content, _ = post(connection, "/features", JPEG, X_Request_Id=f"{name}.msgpack", **headers)
    return dict(msgspec.msgpack.decode(content))


def by_tensors(connection: Connection, name: str) -> dict[str, Any]:
    """The Open Inference Protocol in JSON: (values by output, `parameters`)."""
    tensor = {"name": "image", "shape": [1, 1], "datatype": "BYTES"}
    request = {"inputs": [{**tensor, "data": [base64.b64encode(JPEG).decode()]}]}
    content, _ = post(connection, INFER, json.dumps(request).encode(), X_Request_Id=f"{name}.v2")
    answer = json.loads(content)
    found = {output["name"]: output["data"] for output in answer["outputs"]}
    return {**as_features({k: list(v) for k, v in found.items()}), **answer["parameters"]}


def by_raw_tensors(connection: Connection, name: str) -> dict[str, Any]:
    raw = struct.pack("<I", len(JPEG)) + JPEG
    tensor = {"name": "image", "shape": [1, 1], "datatype": "BYTES"}
    request = {
        "inputs": [{**tensor, "parameters": {"binary_data_size": len(raw)}}],
        "parameters": {"binary_data_output": True},
    }
    head = json.dumps(request).encode()
    length = {"Inference_Header_Content_Length": str(len(head))}
    content, end = post(connection, INFER, head + raw, X_Request_Id=f"{name}.raw", **length)
    answer = json.loads(content[:end])
    found = {}
    for output in answer["outputs"]:
        size = output["parameters"]["binary_data_size"]
        values = np.frombuffer(content[end : end + size], "<f4").tolist()
        found[output["name"]] = [None if np.isnan(v) else v for v in values]
        end += size
    assert end == len(content)
    return {**as_features(found), **answer["parameters"]}


def by_websocket(port: int, name: str) -> dict[str, Any]:
    headers = {"X-Request-Id": f"{name}.stream"}
    with connect(
        f"ws://127.0.0.1:{port}/stream", additional_headers=headers, open_timeout=60
    ) as socket:
        socket.send(JPEG)
        return dict(json.loads(socket.recv(60)))


def as_features(tensors: dict[str, list[float | None]]) -> dict[str, Any]:
    """Tensors by the names that POST /features has."""
    stds = ("ml", "mr", "l", "m", "r", "to_lane_centre", "angle")
    spread = dict(zip(stds, tensors["std"], strict=True))
    (out,) = tensors["out_of_distribution"]
    return {
        "distances_m": dict(zip(tf.MARKINGS, tensors["distances_m"], strict=True)),
        "to_lane_centre_m": tensors["to_lane_centre_m"][0],
        "angle_rad": tensors["angle_rad"][0],
        "heading": dict(zip(("left", "straight", "right"), tensors["heading"], strict=True)),
        "std": None if spread["angle"] is None else spread,
        "out_of_distribution": None if out is None else bool(out),
    }


def narrowed(value: Any) -> Any:
    """An answer with its numbers as float32, the type of a tensor."""
    if isinstance(value, dict):
        return {name: narrowed(part) for name, part in value.items()}
    return float(np.float32(value)) if isinstance(value, float) else value


def test_workers_types_and_endpoints_say_the_same(published: Path) -> None:
    options = ("--port", "0", "--workers", "2", "--log-answers")
    with started("--model", str(published), *options) as (process, line), ExitStack() as stack:
        port = int(address(line).rpartition(":")[2])
        Client(address(line), timeout_s=120).wait_until_ready(120)
        until(lambda: b"driverview_workers_ready 2" in page(port))
        plain, tensors = [], []
        for number in range(CONNECTIONS):  # all stay open, so that the workers share them
            name = f"c{number}"
            connection = Connection("127.0.0.1", port, timeout=120)
            stack.enter_context(closing(connection))
            plain += [by_json(connection, name), by_messagepack(connection, name)]
            plain += [by_websocket(port, name)]
            tensors += [by_tensors(connection, name), by_raw_tensors(connection, name)]
        process.send_signal(signal.SIGTERM)
        assert process.wait(120) == 0
        assert process.stderr is not None
        ways = ways_by_worker(process.stderr)
    first = {name: plain[0][name] for name in (*SAID, *FROM)}
    assert all({name: answer[name] for name in first} == first for answer in plain)
    assert all({name: answer[name] for name in first} == narrowed(first) for answer in tensors)
    assert len(ways) == 2  # both workers had a part in it, by every way over HTTP
    assert all(found >= {"json", "msgpack", "v2", "raw"} for found in ways.values())
    assert set().union(*ways.values()) == {"json", "msgpack", "v2", "raw", "stream"}


def page(port: int) -> bytes:
    """The metrics of all workers."""
    with closing(Connection("127.0.0.1", port, timeout=120)) as connection:
        connection.request("GET", "/metrics")
        return connection.getresponse().read()


def ways_by_worker(lines: Iterator[str]) -> dict[int, set[str]]:
    """Which ways into the service each worker has answered, by its log."""
    ways: dict[int, set[str]] = defaultdict(set)
    for line in lines:
        told = json.loads(line)
        if told["message"] == "answered":
            ways[told["pid"]].add(told["request"].partition(".")[2].partition("/")[0])
    return ways


@pytest.fixture(scope="module")
def lively(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained network with larger weights: its answers change with the image, as a trained
    one's do, by more than the tolerances."""
    import torch

    from mtlnet.export.publish import publish
    from mtlnet.model.network import Network

    torch.manual_seed(3)
    network = Network()
    with torch.no_grad():
        for weights in network.parameters():
            if weights.ndim > 1:
                weights.mul_(2.2)
    run = tmp_path_factory.mktemp("lively") / "run"
    publish(network, run, golden_image(280, 210)[None])
    return run


@pytest.fixture(scope="module")
def oracle(lively: Path) -> Engine:
    return load_engine(lively, "torch")


def seen(image: bytes) -> NDArray[np.uint8]:
    """What an engine gets to see of an image."""
    camera = CameraParameters()
    return decode(image, inspect(image, camera), camera)


@pytest.mark.parametrize("precision", ["f32", "bf16"])
def test_engines_say_the_same_within_the_stated_tolerance(
    lively: Path, oracle: Engine, precision: Literal["f32", "bf16"]
) -> None:
    """Coded outputs and probabilities, from which the answer follows by one law."""
    engine = load_engine(lively, "openvino", precision)
    assert (engine.kind, engine.precision) == ("openvino", precision)
    image, other = seen(JPEG), seen(jpeg(picture()[:, :, ::-1]))
    exact = oracle(image)
    assert np.abs(exact - engine(image)).max() <= TOLERANCE[precision]
    assert np.abs(exact - engine(other)).max() > 2 * TOLERANCE[precision]
    for found in (oracle, engine):
        with serving(found) as service:
            answer = service.post(JPEG).content
        said = decode_outputs(found(image)).as_json()
        assert {name: answer[name] for name in said} == said
        assert (answer["engine"], answer["precision"]) == (found.kind, found.precision)
