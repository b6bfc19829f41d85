"""The Open Inference Protocol v2 over HTTP, for clients of Triton and KServe: the model `track`.

Inputs: `image` (BYTES [1, 1], the bytes of a JPEG or PNG file) or `pixels` (UINT8 [1, height,
width, 3], RGB). Outputs, float32: `distances_m` (1, 5) in the order ml, mr, l, m, r, NaN if absent;
`std` (1, 7), the standard deviations of these distances and of the offset from the lane centre (m),
and of the angle (rad); `out_of_distribution` (1, 1), 0 or 1; `absent` (1, 5), the probabilities of
absence in the order of the distances; `to_lane_centre_m` (1, 1), `angle_rad` (1, 1) and `heading`
(1, 3) as in POST /features. The options of an image are the same as for POST /features, in headers,
in the query, or in `parameters`.

As in Triton, the parameters `binary_data` and `binary_data_output` select JSON or binary outputs,
not the header Accept, which many clients set to application/json for all requests.
"""

import asyncio
import json
import logging
import time
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, Response
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.image_decoding.decode import check_size, decode_whole, read_header
from mtlnet.inference.image_decoding.errors import ImageError
from mtlnet.inference.prediction import FEATURES, Prediction
from serve.api.features import FrameHandler, ImageCamera
from serve.api.kserve_tensors import (
    PAUSE_S,
    WINDOW_BYTES,
    InferRequest,
    encode_response,
    find_pixels,
    invalid_request,
    parse_request,
    read_image_bytes,
    read_json_length,
    take_options,
)
from serve.api.request_options import (
    KSERVE_FORMATS,
    check_body_headers,
    merge_options,
    parse_options,
    read_options,
    request_id_of,
)
from serve.api.schemas import REFUSALS, image_parameters, problem_responses
from serve.asgi import ClientDisconnectedError, client_address, read_body
from serve.problems import MEDIA_TYPE, NOT_READY, Problem, internal_error, with_error
from serve.scheduling.fair_lock import FairLock
from serve.scheduling.frame import PixelReader

NAME, VERSION = "track", "1"
HEADER = "Inference-Header-Content-Length"
MODEL = f"/v2/models/{NAME}"
MODELS = (MODEL, f"{MODEL}/versions/{VERSION}")
PROBES = {"/v2/health/live", "/v2/health/ready", *(f"{model}/ready" for model in MODELS)}
INFER_PATHS = {f"{model}/infer" for model in MODELS}
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
    "absent": len(tf.MARKINGS),
}
# The OpenAPI operation of an inference request, without the header parameters of an image.
OPERATION: dict[str, Any] = json.loads(
    Path(__file__).with_name("kserve_infer.json").read_text(encoding="utf-8")
)

logger = logging.getLogger(__name__)


def add_kserve(app: FastAPI, frames: FrameHandler) -> None:
    """Add the paths of the Open Inference Protocol to `app`."""
    not_ready = problem_responses(NOT_READY)
    responses = {**OPERATION["responses"], **problem_responses(*REFUSALS)}
    extra = {
        "parameters": [*OPERATION["parameters"], *image_parameters()],
        "requestBody": OPERATION["requestBody"],
    }

    @app.get("/v2/health/live", summary="Is the process alive?")
    async def live() -> dict[str, Any]:
        return {"live": True}

    @app.get("/v2/health/ready", summary="Is the service ready?", responses=not_ready)
    async def ready() -> dict[str, Any]:
        frames.queue.check_ready()
        return {"ready": True}

    async def model_ready() -> dict[str, Any]:
        frames.queue.check_ready()
        return {"name": NAME, "ready": True}

    @app.get("/v2", summary="Name, version and extensions of the service (Open Inference Protocol)")
    async def server() -> dict[str, Any]:
        extensions = ["binary_tensor_data"]
        return {"name": "driverview", "version": version("driverview"), "extensions": extensions}

    for model in MODELS:
        add: dict[str, Any] = {"include_in_schema": model == MODEL}
        app.get(model, summary="The model's inputs and outputs", **add)(_metadata(frames))
        app.get(f"{model}/ready", summary="Is the model ready?", responses=not_ready, **add)(
            model_ready
        )
        app.post(
            f"{model}/infer",
            summary="Track features of one image, as tensors",
            responses=responses,
            openapi_extra=extra,
            **add,
        )(_infer(frames))


def _metadata(frames: FrameHandler) -> Any:
    async def metadata() -> dict[str, Any]:
        outputs = [{"name": k, "datatype": "FP32", "shape": [1, n]} for k, n in OUTPUTS.items()]
        platform = f"driverview_{frames.queue.loaded.provenance['engine']}"
        content = {"name": NAME, "versions": [VERSION], "platform": platform}
        return {**content, "inputs": INPUTS, "outputs": outputs}

    return metadata


def _infer(frames: FrameHandler) -> Any:
    one_large = FairLock()  # one large JSON part is parsed at a time; clients take turns

    async def infer(request: Request) -> Response:
        stamp_ns = time.monotonic_ns()
        request_id = request_id_of(dict(request.scope["headers"]))
        client = client_address(request.scope)
        try:
            return await _answer(frames, request, stamp_ns, request_id, one_large)
        except ClientDisconnectedError:
            return Response(status_code=400)  # never sent
        except (Problem, ImageError) as error:
            problem = frames.record_refusal(error, request_id, client)
        except Exception:
            logger.exception("request %s failed", request_id)
            problem = frames.record_refusal(internal_error(), request_id, client)
        content = with_error(problem.content, MODEL)
        sent = {**problem.headers, "X-Request-Id": request_id}
        return JSONResponse(content, problem.type.status, sent, MEDIA_TYPE)

    return infer


async def _answer(
    frames: FrameHandler,
    request: Request,
    stamp_ns: int,
    request_id: str,
    one_large: FairLock,
) -> Response:
    headers = read_options(request.scope)
    options = parse_options(headers, stamp_ns, request_id, KSERVE_FORMATS)
    check_body_headers(headers)
    frames.queue.check_ready()
    client = client_address(request.scope)
    full = None if options.stream is not None else frames.queue.refusal(client)
    if full is not None:
        raise full  # an overloaded worker reads and parses nothing
    share = frames.share()
    try:
        body = await read_body(request.receive, share.receive)
        length = read_json_length(body, headers.get(HEADER.lower().encode()))
        large = length > WINDOW_BYTES
        async with one_large.held(client) if large else nullcontext():
            if large:
                await asyncio.sleep(PAUSE_S)
            infer_request, binary = parse_request(body, length)
            more = take_options(infer_request)
            if more:
                headers = merge_options(headers, more, "parameters")
                options = parse_options(headers, stamp_ns, request_id, KSERVE_FORMATS)
            share.grow(len(infer_request.input.data))  # a copy; freed after decoding
            read, read_ms = await _pixel_reader(
                infer_request, binary, frames, frames.image_camera(options)
            )
            infer_request.input.data = b""
            del body, binary
        result = await frames.predict_pixels(options, client, read, read_ms)
    finally:
        share.close()
    about = result.provenance
    if options.frame_id is not None:
        about = {**about, "frame_id": options.frame_id}
    head: dict[str, Any] = {"model_name": NAME, "model_version": VERSION, "parameters": about}
    if infer_request.id is not None:
        head["id"] = infer_request.id
    content, json_length = encode_response(head, _tensors(result.prediction), infer_request)
    sent = {"X-Request-Id": request_id}
    if json_length is None:
        return Response(content, media_type="application/json", headers=sent)
    sent[HEADER] = str(json_length)
    return Response(content, media_type="application/octet-stream", headers=sent)


async def _pixel_reader(
    request: InferRequest, binary: memoryview, frames: FrameHandler, source: ImageCamera
) -> tuple[PixelReader, float]:
    """Check a request and return a function that reads its pixels, with the estimated time in ms.

    Raises Problem, ImageError.
    """
    tensor = request.input
    if tensor.name not in ("image", "pixels"):
        raise invalid_request("expected one input, named image or pixels")
    if len({output.name for output in request.outputs}) < len(request.outputs):
        raise invalid_request("an output is requested twice; request each output once")
    unknown = next((o.name for o in request.outputs if o.name not in OUTPUTS), None)
    if unknown is not None:
        raise invalid_request(f"unknown output {unknown[:80]!r}; known are {', '.join(OUTPUTS)}")
    if tensor.name == "image":
        body = await read_image_bytes(tensor, binary)
        header = read_header(body)
        source.crop_px(header.width, header.height, frames.queue.loaded)
        return lambda to: source.to_model_view(decode_whole(body, header), to), header.decode_ms
    pixels = find_pixels(tensor, binary)
    check_size(pixels.width, pixels.height)
    source.crop_px(pixels.width, pixels.height, frames.queue.loaded)
    return lambda to: source.to_model_view(pixels.read(), to), pixels.read_ms


def _tensors(prediction: Prediction) -> dict[str, NDArray[np.float32]]:
    """The output tensors of a prediction by name, each (1, n) float32; NaN if absent."""
    rows: dict[str, list[float | None]] = {
        "distances_m": [prediction.distances_m[name] for name in tf.MARKINGS],
        "to_lane_centre_m": [prediction.to_lane_centre_m],
        "angle_rad": [prediction.angle_rad],
        "heading": [prediction.heading[name] for name in ("left", "straight", "right")],
        "std": [(prediction.std or {}).get(name) for name in FEATURES],
        "out_of_distribution": [prediction.out_of_distribution],
        "absent": [(prediction.absent or {}).get(name) for name in tf.MARKINGS],
    }
    return {k: np.array([row], np.float32) for k, row in rows.items()}  # None becomes NaN
