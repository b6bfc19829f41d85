"""Answers for one image are equal across workers, engines, media types and endpoints."""

import base64
import json
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from websockets.sync.client import connect

import trackfeatures as tf
from mtlnet.inference.engine import Engine, best_precision, load_engine
from mtlnet.inference.golden_image import golden_image
from mtlnet.inference.image_decoding.decode import crop_and_resize, decode_whole, read_header
from mtlnet.inference.prediction import decode_outputs
from serve.scheduling.warmup import TOLERANCE, warm_up
from serve.shared_memory import create_shared_memory
from tests.serve.conftest import (
    INFER,
    JPEG,
    PATIENCE_S,
    Served,
    jpeg,
    picture,
    serving,
    tensor_request,
    until,
)
from trackfeatures.camera import CameraParameters

FEATURES = (
    "distances_m", "to_lane_centre_m", "angle_rad", "heading",
    "std", "out_of_distribution", "absent",
)  # fmt: skip
PROVENANCE = ("model", "engine", "precision", "definitions_version")


def by_json(service: Served) -> dict[str, Any]:
    return dict(service.post(JPEG).content)


def by_messagepack(service: Served) -> dict[str, Any]:
    return dict(msgspec.msgpack.decode(service.post(JPEG, Accept="application/msgpack").content))


def by_tensors(service: Served) -> dict[str, Any]:
    """The answer of the Open Inference Protocol in JSON."""
    tensor = {"name": "image", "shape": [1, 1], "datatype": "BYTES"}
    request = {"inputs": [{**tensor, "data": [base64.b64encode(JPEG).decode()]}]}
    answer = service.ask("POST", INFER, json.dumps(request).encode()).content
    found = {output["name"]: output["data"] for output in answer["outputs"]}
    return {**as_features({k: list(v) for k, v in found.items()}), **answer["parameters"]}


def by_raw_tensors(service: Served) -> dict[str, Any]:
    headers, body = tensor_request(JPEG, parameters={"binary_data_output": True})
    reply = service.ask("POST", INFER, body, headers)
    content, end = reply.content, int(reply.headers["inference-header-content-length"])
    answer = json.loads(content[:end])
    found = {}
    for output in answer["outputs"]:
        size = output["parameters"]["binary_data_size"]
        values = np.frombuffer(content[end : end + size], "<f4").tolist()
        found[output["name"]] = [None if np.isnan(v) else v for v in values]
        end += size
    assert end == len(content)
    return {**as_features(found), **answer["parameters"]}


def by_websocket(port: int) -> dict[str, Any]:
    with connect(f"ws://127.0.0.1:{port}/stream", open_timeout=PATIENCE_S) as socket:
        socket.send(JPEG)
        return dict(json.loads(socket.recv(PATIENCE_S)))


def as_features(tensors: dict[str, list[float | None]]) -> dict[str, Any]:
    """Output tensors, converted to the form of an answer of POST /features."""
    stds = ("ml", "mr", "l", "m", "r", "to_lane_centre", "angle")
    spread = dict(zip(stds, tensors["std"], strict=True))
    absent = dict(zip(tf.MARKINGS, tensors["absent"], strict=True))
    (out,) = tensors["out_of_distribution"]
    return {
        "distances_m": dict(zip(tf.MARKINGS, tensors["distances_m"], strict=True)),
        "to_lane_centre_m": tensors["to_lane_centre_m"][0],
        "angle_rad": tensors["angle_rad"][0],
        "heading": dict(zip(("left", "straight", "right"), tensors["heading"], strict=True)),
        "std": None if spread["angle"] is None else spread,
        "out_of_distribution": None if out is None else bool(out),
        "absent": None if absent["ml"] is None else absent,
    }


def narrowed(value: Any) -> Any:
    """An answer with its numbers rounded to float32, the type of the tensors."""
    if isinstance(value, dict):
        return {name: narrowed(part) for name, part in value.items()}
    return float(np.float32(value)) if isinstance(value, float) else value


def test_workers_types_and_endpoints_give_the_same_answer(published: Path) -> None:
    """Two workers on two ports give equal answers for every media type and endpoint."""
    memory = create_shared_memory(blocks=2)
    plain, tensors = [], []
    with (
        serving(load_engine(published), warm_up, shared=memory, block=0) as one,
        serving(load_engine(published), warm_up, shared=memory, block=1) as two,
    ):
        for service in (one, two):
            until(lambda: service.app.frame_queue.ready)  # noqa: B023
            plain += [by_json(service), by_messagepack(service), by_websocket(service.port)]
            tensors += [by_tensors(service), by_raw_tensors(service)]
    first = {name: plain[0][name] for name in (*FEATURES, *PROVENANCE)}
    assert all({name: answer[name] for name in first} == first for answer in plain)
    assert all({name: answer[name] for name in first} == narrowed(first) for answer in tensors)


@pytest.fixture(scope="module")
def sensitive_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained network with enlarged weights. Like those of a trained network, its outputs
    differ between images by more than the tolerances."""
    import torch

    from mtlnet.export.publish import publish
    from mtlnet.model.network import Network

    torch.manual_seed(3)
    network = Network()
    with torch.no_grad():
        for weights in network.parameters():
            if weights.ndim > 1:
                weights.mul_(2.2)
    run = tmp_path_factory.mktemp("sensitive") / "run"
    publish(network, run, golden_image(280, 210)[None])
    return run


@pytest.fixture(scope="module")
def oracle(sensitive_model: Path) -> Engine:
    return load_engine(sensitive_model, "torch")


def model_input(image: bytes) -> NDArray[np.uint8]:
    """The pixels of an image file in the form that an engine receives."""
    camera = CameraParameters()
    return crop_and_resize(decode_whole(image, read_header(image)), camera)


@pytest.mark.parametrize("precision", ["f32", "bf16"])
def test_engines_agree_within_the_stated_tolerance(
    sensitive_model: Path, oracle: Engine, precision: Literal["f32", "bf16"]
) -> None:
    """The coded outputs and probabilities are compared; answers are decoded from them."""
    engine = load_engine(sensitive_model, "openvino", precision)
    computed = "f32" if precision == "bf16" and best_precision() == "f32" else precision
    assert (engine.kind, engine.precision) == ("openvino", computed)
    image, other = model_input(JPEG), model_input(jpeg(picture()[:, :, ::-1]))
    exact = oracle(image)
    assert np.abs(exact - engine(image)).max() <= TOLERANCE[precision]
    assert np.abs(exact - engine(other)).max() > 2 * TOLERANCE[precision]
    for found in (oracle, engine):
        with serving(found) as service:
            answer = service.post(JPEG).content
        expected = decode_outputs(found(image)).as_json()
        assert {name: answer[name] for name in expected} == expected
        assert (answer["engine"], answer["precision"]) == (found.kind, found.precision)
