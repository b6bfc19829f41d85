"""Schemas of the answers, and the parts of the OpenAPI document that FastAPI cannot generate."""

from collections.abc import Collection
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel, Field, JsonValue

from serve import problems
from serve.api.request_options import (
    CAMERA,
    DEADLINE,
    FIELD_OF_VIEW,
    FORMATS,
    FRAME_ID,
    MAX_FOV_DEG,
    MEDIA_TYPES,
    MIN_FOV_DEG,
    OPTIONS,
    REQUEST_ID,
    STREAM_ID,
)
from serve.config import MAX_DEADLINE_MS, MAX_NAME
from serve.problems import MEDIA_TYPE, PROBLEM_TYPES, ProblemType

PROBLEM_URIS: list[JsonValue] = [*(found.uri for found in PROBLEM_TYPES), "about:blank"]


class Distances(BaseModel):
    """Signed distances to lane markings in m, left negative; null if the marking is absent."""

    ml: float | None = Field(description="left marking of the car's lane")
    mr: float | None = Field(description="right marking of the car's lane")
    l: float | None = Field(description="next marking to the left of m")
    m: float | None = Field(description="marking that the car is driving on")
    r: float | None = Field(description="next marking to the right of m")


class HeadingProbabilities(BaseModel):
    """Probabilities of the three classes of the road; they sum to 1."""

    left: float = Field(description="probability of a bend to the left")
    straight: float = Field(description="probability of a straight road")
    right: float = Field(description="probability of a bend to the right")


class Deviations(Distances):
    """Standard deviation of the error of each feature, m and rad; null if the feature is absent."""

    to_lane_centre: float | None = Field(description="standard deviation of to_lane_centre_m, m")
    angle: float = Field(description="standard deviation of angle_rad, rad")


class AbsentProbabilities(BaseModel):
    """Probability that each marking is absent; above 0.54 (`l`, `r`: 0.75) a distance is null."""

    ml: float = Field(description="left marking of the car's lane; always equal to mr")
    mr: float = Field(description="right marking of the car's lane")
    l: float = Field(description="next marking to the left of m")
    m: float = Field(description="marking that the car is driving on")
    r: float = Field(description="next marking to the right of m")


class Timing(BaseModel):
    """Time of each stage in ms. `queue` and `total` include receiving the body."""

    queue: float = Field(description="from the start of the request to the start of decoding")
    decode: float = Field(description="decoding, cropping and resizing of the image")
    forward: float = Field(description="forward pass of the network")
    total: float = Field(description="from the start of the request to the answer")


class Features(BaseModel):
    """Track features predicted from one driver-view image."""

    distances_m: Distances
    to_lane_centre_m: float | None = Field(
        description="offset from the centre of the car's lane or of the nearest lane, m, left "
        "positive; null if no marking is near"
    )
    angle_rad: float = Field(
        description="track heading minus the car's heading, rad: positive if the car points right"
    )
    heading: HeadingProbabilities
    std: Deviations | None = Field(description="null if the model has no uncertainty head")
    out_of_distribution: bool | None = Field(
        description="whether the image is unlike the training images; if true, do not drive with "
        "the prediction. null if the model has no uncertainty head"
    )
    absent: AbsentProbabilities | None = Field(
        description="null if the model has the paper's heads, which output coded numbers"
    )
    model: str = Field(description="hash of the model's weights")
    definitions_version: str = Field(description="version of the definitions of the features")
    engine: str = Field(description="openvino or torch")
    precision: str = Field(description="f32, bf16 or int8")
    crop_px: list[int] | None = Field(
        description="left, top, width, height of the used part of the image, px; null if the whole "
        "image is used or it was warped (X-Camera)",
        min_length=4,
        max_length=4,
    )
    timing_ms: Timing
    frame_id: str | None = Field(description=f"the request's {FRAME_ID}; null without one")


class Status(BaseModel):
    """State of the service."""

    status: str
    model: str | None = Field(default=None, description="hash of the current weights")


class ProblemDetails(BaseModel):
    """Why a request was refused (RFC 9457)."""

    type: str = Field(
        description="the type of the problem; never changes",
        json_schema_extra={"enum": PROBLEM_URIS},
    )
    title: str
    status: int
    detail: str = Field(description="what was seen, what was expected and what to do")
    retry_after_ms: int | None = Field(
        default=None, description="time until a retry, ms; only if a retry can help"
    )


# Refusals of any request. AUTHORIZATION_REFUSALS do not concern probes, which need no token.
SERVER_REFUSALS = (
    problems.MALFORMED,
    problems.TOO_SLOW,
    problems.HEAD_TOO_LARGE,
    problems.TOO_MANY_CONNECTIONS,
    problems.FORBIDDEN_ORIGIN,
    problems.FORBIDDEN_HOST,
    problems.RATE_LIMITED,
)
AUTHORIZATION_REFUSALS = (problems.UNAUTHORIZED,)
OTHER_REFUSALS = (problems.NOT_FOUND, problems.METHOD_NOT_ALLOWED)
REFUSALS = tuple(  # refusals of an image
    found
    for found in PROBLEM_TYPES
    if found not in (*SERVER_REFUSALS, *AUTHORIZATION_REFUSALS, *OTHER_REFUSALS)
)
NAME: dict[str, Any] = {
    "type": "string",
    "minLength": 1,
    "maxLength": MAX_NAME,
    "pattern": "^[ -~]*$",
}
HEADERS: dict[str, tuple[str, dict[str, Any]]] = {
    FRAME_ID: ("Returned as `frame_id`. Printable ASCII.", NAME),
    STREAM_ID: (
        "Name of a stream of frames of this client, for example of one camera. A newer frame of "
        "the stream replaces a queued one, which is answered with 503, `superseded`.",
        NAME,
    ),
    DEADLINE: (
        "Deadline in ms from the start of the request. A frame whose processing has not begun by "
        "then is answered with 503, `deadline-passed`.",
        {"type": "number", "minimum": 0, "maximum": MAX_DEADLINE_MS},
    ),
    CAMERA: (
        "Name of a camera that the service was started with (`serve --camera NAME=FILE`); GET "
        "/model lists the names under `cameras`. The image is warped into the view of the model's "
        "camera, and the distances are measured from the named camera's car. Cannot be combined "
        "with X-Camera-Fov-Y.",
        NAME,
    ),
    FIELD_OF_VIEW: (
        "Vertical field of view of the image in degrees. Default: the value of the model's camera. "
        "An image with a larger value is cropped to the model's view.",
        {"type": "number", "minimum": MIN_FOV_DEG, "maximum": MAX_FOV_DEG},
    ),
    REQUEST_ID: (
        "Returned in a header of the same name, and written to the log. The service replaces a "
        f"value that is not printable ASCII or has more than {MAX_NAME} characters.",
        {"type": "string"},
    ),
}


def image_parameters() -> list[dict[str, Any]]:
    """Return the OpenAPI parameters of an image: its request headers, and the same options in the
    query."""
    common = {"in": "header", "required": False}
    found = [
        {"name": name, **common, "description": text, "schema": schema}
        for name, (text, schema) in HEADERS.items()
    ]
    for name, header in OPTIONS.items():
        text = f"Same as the header {header}; only one of the two can be sent."
        schema = HEADERS[header][1]
        found.append({**common, "in": "query", "name": name, "description": text, "schema": schema})
    return found


def features_operation() -> dict[str, Any]:
    """Return the OpenAPI operation of POST /features, which is not a route of FastAPI."""
    schema = {"$ref": "#/components/schemas/Features"}
    return {
        "summary": "Track features of one driver-view image",
        "operationId": "features",
        "parameters": image_parameters(),
        "requestBody": {
            "required": True,
            "description": "The bytes of one JPEG or PNG file (no form, no base64) of at most "
            "4 MiB, with sides of 16 to 4096 px and at most 8.4 million px. A wider image is "
            "cropped to the model's view; an image that does not contain this view is refused.",
            "content": {
                name: {"schema": {"type": "string", "format": "binary", "contentMediaType": name}}
                for name in MEDIA_TYPES
            },
        },
        "responses": {
            "200": {
                "description": "The track features, in the media type preferred by `Accept`",
                "content": {form.media_type: {"schema": schema} for form in FORMATS},
            },
            **{str(k): v for k, v in problem_responses(*REFUSALS).items()},
        },
    }


def problem_responses(*types: ProblemType) -> dict[int | str, dict[str, Any]]:
    """Return by HTTP status the OpenAPI responses of a route whose requests can be refused with the
    problems `types`."""
    statuses = dict.fromkeys(found.status for found in types)
    schema = {"$ref": "#/components/schemas/ProblemDetails"}
    return {
        status: {
            "description": "; ".join(found.title for found in types if found.status == status),
            "content": {MEDIA_TYPE: {"schema": schema}},
        }
        for status in statuses
    }


def add_common_responses(operation: dict[str, Any], needs_token: bool) -> None:
    """Add the problems that any request can have to the responses of `operation`, with the problem
    of a missing token if `needs_token` is set."""
    types = (*SERVER_REFUSALS, *AUTHORIZATION_REFUSALS) if needs_token else SERVER_REFUSALS
    responses = operation["responses"]
    for status, response in problem_responses(*types).items():
        own = responses.get(str(status))
        if own is not None:
            response["description"] = f"{own['description']}; {response['description']}"
        responses[str(status)] = response


def _add_request_id(responses: dict[str, Any]) -> None:
    """Add the header X-Request-Id to all `responses` of an operation."""
    sent = {"description": "The request's id.", "schema": NAME}
    for status, response in responses.items():
        headers = {**response.get("headers", {}), REQUEST_ID: sent}
        responses[status] = {**response, "headers": headers}


def install_openapi(app: FastAPI, public: Collection[str], token_required: bool) -> None:
    """Complete the OpenAPI document of `app` with the paths and schemas that FastAPI lacks.

    `public` are the paths that need no token.
    """

    def document() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = get_openapi(
                title=app.title,
                version=app.version,
                description=app.description,
                routes=app.routes,
            )
            _complete(schema, public, token_required)
            app.openapi_schema = schema
        return app.openapi_schema

    app.openapi = document  # type: ignore[method-assign]  # FastAPI's documented way to extend it


def _complete(schema: dict[str, Any], public: Collection[str], token_required: bool) -> None:
    components = schema.setdefault("components", {})
    schemas = components.setdefault("schemas", {})
    for model in (ProblemDetails, Features):
        definition = model.model_json_schema(ref_template="#/components/schemas/{model}")
        schemas.update(definition.pop("$defs", {}))
        schemas[model.__name__] = definition
    if token_required:
        components["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
    schema["paths"] = {"/features": {"post": features_operation()}, **schema["paths"]}
    for path, item in schema["paths"].items():
        for operation in item.values():
            add_common_responses(operation, path not in public)
            if any(each["name"] == REQUEST_ID for each in operation.get("parameters", ())):
                _add_request_id(operation["responses"])
            if token_required and path not in public:
                operation["security"] = [{"token": []}]
