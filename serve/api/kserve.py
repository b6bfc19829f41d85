"""The Open Inference Protocol v2 over HTTP, for clients of Triton and KServe: the model `track`.

Inputs: `image` (BYTES [1, 1], the bytes of a JPEG or PNG file) or `pixels` (UINT8 [1, height,
width, 3], RGB). Outputs, float32: `distances_m` (1, 5) in the order ml, mr, l, m, r, NaN where
absent; `std` in the order of `mtlnet.inference.uncertainty`; `out_of_distribution` 0 or 1; the
others are named and mean as in POST /features, whose request headers hold here too.
"""

import logging
import time
from importlib.metadata import version
from typing import Any

import numpy as np
from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, Response
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.image_decoding.decode import check_size, crop_and_resize, decode, inspect
from mtlnet.inference.image_decoding.errors import ImageError
from mtlnet.inference.prediction import Prediction
from mtlnet.inference.uncertainty import FEATURES
from serve.api.features import FrameHandler, client_of
from serve.api.http_io import Departed, read_body
from serve.api.kserve_tensors import (
    InferRequest,
    invalid,
    parse,
    read_image_bytes,
    read_pixels,
    write,
)
from serve.api.problems import MEDIA_TYPE, NOT_READY, Problem, failure
from serve.api.request_options import Headers, check_body_headers, read_ask, request_id
from serve.api.schemas import REFUSALS, header_parameters, problem_responses
from serve.config import MAX_BODY_BYTES
from serve.scheduling.frame_queue import Reader

NAME, VERSION = "track", "1"
HEADER = "Inference-Header-Content-Length"
MODEL = f"/v2/models/{NAME}"
MODELS = (MODEL, f"{MODEL}/versions/{VERSION}")
PROBES = {"/v2/health/live", "/v2/health/ready", *(f"{model}/ready" for model in MODELS)}
INPUTS = [
    {"name": "image", "datatype": "BYTES", "shape": [1, 1]},
    {"name": "pixels", "datatype": "UINT8", "shape": [1, -1, -1, 3]},
]
OUTPUTS = {
    "distances_m": 5,
    "to_lane_centre_m": 1,
    "angle_rad": 1,
    "heading": 3,
    "std": len(FEATURES),
    "out_of_distribution": 1,
}
PARAMETERS: dict[str, Any] = {"type": "object"}
TENSOR: dict[str, Any] = {
    "type": "object",
    "required": ["name", "shape", "datatype"],
    "properties": {
        "name": {"enum": [tensor["name"] for tensor in INPUTS]},
        "shape": {"type": "array", "items": {"type": "integer"}},
        "datatype": {"enum": [tensor["datatype"] for tensor in INPUTS]},
        "parameters": {
            **PARAMETERS,
            "description": "`binary_data_size`: the bytes of this tensor follow the JSON part",
        },
        "data": {"description": "a file in base64, or values from 0 to 255, row by row"},
    },
}
REQUEST: dict[str, Any] = {
    "type": "object",
    "required": ["inputs"],
    "properties": {
        "id": {"type": ["string", "null"], "description": "comes back in the answer"},
        "inputs": {"type": "array", "minItems": 1, "maxItems": 1, "items": TENSOR},
        "outputs": {
            "type": "array",
            "description": "which outputs are wanted; without it, all",
            "items": {
                "type": "object",
                "required": ["name"],
                "properties": {"name": {"enum": [*OUTPUTS]}, "parameters": PARAMETERS},
            },
        },
        "parameters": {
            **PARAMETERS,
            "description": "`binary_data_output`: outputs are wanted as bytes behind the JSON part",
        },
    },
}
INFER_BODY: dict[str, Any] = {
    "parameters": [
        {
            "name": HEADER,
            "in": "header",
            "required": False,
            "description": "Bytes of the body's JSON part, where binary tensors follow it",
            "schema": {"type": "integer", "minimum": 0, "maximum": MAX_BODY_BYTES},
        },
        *header_parameters(),
    ],
    "requestBody": {
        "required": True,
        "description": "An inference request in JSON; with its header's length also binary tensors",
        "content": {
            "application/json": {"schema": REQUEST},
            "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
        },
    },
}
BINARY_ANSWER: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The outputs, in JSON, or with binary ones behind it",
        "content": {
            "application/json": {"schema": {"type": "object"}},
            "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
        },
    }
}

logger = logging.getLogger(__name__)


def install(app: FastAPI, sight: FrameHandler) -> None:
    """Add the protocol's paths to `app`."""
    not_ready = problem_responses(NOT_READY)

    @app.get("/v2/health/live", summary="Is the process alive?")
    async def live() -> dict[str, Any]:
        return {"live": True}

    @app.get("/v2/health/ready", summary="Is the service ready?", responses=not_ready)
    async def ready() -> dict[str, Any]:
        sight.perceiver.check_ready()
        return {"ready": True}

    @app.get("/v2", summary="The service, as the Open Inference Protocol describes it")
    async def server() -> dict[str, Any]:
        extensions = ["binary_tensor_data"]
        return {"name": "driverview", "version": version("driverview"), "extensions": extensions}

    for model in MODELS:
        hidden = model != MODEL
        add: dict[str, Any] = {"include_in_schema": not hidden}
        app.get(model, summary="The model's inputs and outputs", **add)(_metadata(sight))
        app.get(f"{model}/ready", summary="Is the model ready?", responses=not_ready, **add)(ready)
        app.post(
            f"{model}/infer",
            summary="Track features of one image, as tensors",
            responses={**BINARY_ANSWER, **problem_responses(*REFUSALS)},
            openapi_extra=INFER_BODY,
            **add,
        )(_infer(sight))


def _metadata(sight: FrameHandler) -> Any:
    async def metadata() -> dict[str, Any]:
        outputs = [{"name": k, "datatype": "FP32", "shape": [1, n]} for k, n in OUTPUTS.items()]
        platform = f"driverview_{sight.perceiver.loaded.origin['engine']}"
        found = {"name": NAME, "versions": [VERSION], "platform": platform}
        return {**found, "inputs": INPUTS, "outputs": outputs}

    return metadata


def _infer(sight: FrameHandler) -> Any:
    async def infer(request: Request) -> Response:
        stamp = time.monotonic_ns()
        headers: Headers = dict(request.scope["headers"])
        name, client = request_id(headers), client_of(request.scope)
        try:
            return await _answer(sight, request, headers, stamp, name)
        except Departed:
            return Response(status_code=400)  # nobody reads it
        except (Problem, ImageError) as error:
            problem = sight.refused(error, name, client)
        except Exception:
            logger.exception("request %s failed", name)
            problem = sight.refused(failure(), name, client)
        # The protocol's own member beside those of a problem.
        content = {**problem.content, "error": problem.detail}
        return JSONResponse(content, problem.kind.status, problem.headers, MEDIA_TYPE)

    return infer


async def _answer(
    sight: FrameHandler, request: Request, headers: Headers, stamp_ns: int, name: str
) -> Response:
    ask = read_ask({k: v for k, v in headers.items() if k != b"accept"}, stamp_ns, name)
    check_body_headers(headers)
    body = await read_body(request.receive)
    wanted, binary = parse(body, headers.get(HEADER.lower().encode()))
    sight.perceiver.check_ready()
    read = _reader(wanted, binary, sight, ask.fov_y_deg)
    perceived = await sight.see(ask, client_of(request.scope), read)
    head: dict[str, Any] = {
        "model_name": NAME,
        "model_version": VERSION,
        "parameters": perceived.origin,
    }
    if wanted.id is not None:
        head["id"] = wanted.id
    content, json_length = write(head, _tensors(perceived.answer), wanted)
    if json_length is None:
        return Response(content, media_type="application/json", headers={"X-Request-Id": name})
    sent = {"X-Request-Id": name, HEADER: str(json_length)}
    return Response(content, media_type="application/octet-stream", headers=sent)


def _reader(
    wanted: InferRequest, binary: memoryview, sight: FrameHandler, fov_y_deg: float | None
) -> Reader:
    """How to read the pixels of the one input. Raises Problem, ImageError."""
    if len(wanted.inputs) != 1 or wanted.inputs[0].name not in ("image", "pixels"):
        raise invalid("there must be one input, called image or pixels")
    tensor = wanted.inputs[0]
    unknown = next((o.name for o in wanted.outputs if o.name not in OUTPUTS), None)
    if unknown is not None:
        raise invalid(f"there is no output {unknown[:80]!r}; there are {', '.join(OUTPUTS)}")
    camera = sight.perceiver.loaded.engine.card.camera
    if tensor.name == "image":
        body = read_image_bytes(tensor, binary)
        header = inspect(body, camera, fov_y_deg)
        return lambda view: decode(body, header, view, fov_y_deg)
    pixels = read_pixels(tensor, binary)
    check_size(pixels.shape[1], pixels.shape[0])
    return lambda view: crop_and_resize(pixels, view, fov_y_deg)


def _tensors(answer: Prediction) -> dict[str, NDArray[np.float32]]:
    offset = answer.to_lane_centre_m
    rows: dict[str, list[float | None]] = {
        "distances_m": [answer.distances_m[name] for name in tf.MARKINGS],
        "to_lane_centre_m": [offset],
        "angle_rad": [answer.angle_rad],
        "heading": [answer.heading[name] for name in ("left", "straight", "right")],
        "std": [(answer.std or {}).get(name) for name in FEATURES],
        "out_of_distribution": [answer.out_of_distribution],
    }
    return {k: np.array([row], np.float32) for k, row in rows.items()}  # None becomes NaN
