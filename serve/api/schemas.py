"""Schemas of the answers, and the parts of the OpenAPI document that FastAPI cannot derive."""

from collections.abc import Collection
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel, Field, JsonValue

from serve.api import problems
from serve.api.problems import MEDIA_TYPE, PROBLEM_TYPES, ProblemType
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

PROBLEM_URIS: list[JsonValue] = [*(found.uri for found in PROBLEM_TYPES), "about:blank"]


class Distances(BaseModel):
    """Signed distances to lane markings in m, left negative; null where a marking is absent."""

    ml: float | None = Field(description="left marking of the car's lane")
    mr: float | None = Field(description="right marking of the car's lane")
    l: float | None = Field(description="next marking left of the one driven on")
    m: float | None = Field(description="marking the car is driving on")
    r: float | None = Field(description="next marking right of the one driven on")


class HeadingProbabilities(BaseModel):
    """Probabilities that the road bends left, goes straight, bends right; they sum to 1."""

    left: float = Field(description="of a bend to the left")
    straight: float = Field(description="of a straight road")
    right: float = Field(description="of a bend to the right")


class Deviations(Distances):
    """Standard deviation of the error of each feature, m and rad; null where it is absent."""

    to_lane_centre: float | None = Field(description="of to_lane_centre_m, m")
    angle: float = Field(description="of angle_rad, rad")


class AbsentProbabilities(BaseModel):
    """Probability that each marking is absent; above 0.54 (`l`, `r`: 0.75) a distance is null."""

    ml: float = Field(description="equal to that of mr: a lane has both or none")
    mr: float = Field(description="right marking of the car's lane")
    l: float = Field(description="next marking left of the one driven on")
    m: float = Field(description="marking the car is driving on")
    r: float = Field(description="next marking right of the one driven on")


class Timing(BaseModel):
    """Time of each stage, ms. `queue` and `total` include receiving the body."""

    queue: float = Field(description="from the start of the request to the start of decoding")
    decode: float = Field(description="of the image, with cropping and resizing")
    forward: float = Field(description="of the network")
    total: float = Field(description="from the start of the request to the answer")


class Features(BaseModel):
    """Track features read from one driver-view image."""

    distances_m: Distances
    to_lane_centre_m: float | None = Field(
        description="offset from the centre of the lane the car is in or nearest to, m, left "
        "positive; null where no marking is near"
    )
    angle_rad: float = Field(
        description="track heading minus the car's, rad: positive when the car points to the right"
    )
    heading: HeadingProbabilities
    std: Deviations | None = Field(description="null where the model has no uncertainty head")
    out_of_distribution: bool | None = Field(
        description="the image is unlike the training images: do not drive by the prediction; "
        "null where the model cannot detect it"
    )
    absent: AbsentProbabilities | None = Field(
        description="null where the model answers in the paper's coded numbers"
    )
    model: str = Field(description="hash of the weights that were used")
    definitions_version: str = Field(description="version of the definitions of the features")
    engine: str = Field(description="openvino or torch")
    precision: str = Field(description="f32, bf16 or int8")
    crop_px: list[int] | None = Field(
        description="left, top, width, height of the part of the image that is used, px; null: "
        "all, or it was warped (X-Camera)",
        min_length=4,
        max_length=4,
    )
    timing_ms: Timing
    frame_id: str | None = Field(description=f"the request's {FRAME_ID}, null without one")


class Status(BaseModel):
    """State of the service."""

    status: str
    model: str | None = Field(default=None, description="hash of the weights that will be used")


class ProblemDetails(BaseModel):
    """Why a request was refused (RFC 9457)."""

    type: str = Field(
        description="the type of the problem; stable",
        json_schema_extra={"enum": PROBLEM_URIS},
    )
    title: str
    status: int
    detail: str = Field(description="what was seen, what was expected and what to do")
    retry_after_ms: int | None = Field(
        default=None, description="when to send the request again, ms; only where that may help"
    )


# Refusals of any request. Probes need no token and have no rate limit.
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
REFUSALS = tuple(  # of an image
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
        "Name of a stream of frames of this client, for example of one camera: a newer frame "
        "replaces a queued one, which is answered with 503, `superseded`.",
        NAME,
    ),
    DEADLINE: (
        "A frame that is not processed within this time after its request began, ms, is answered "
        "with 503, `deadline-passed`.",
        {"type": "number", "minimum": 0, "maximum": MAX_DEADLINE_MS},
    ),
    CAMERA: (
        "Name of a camera that the service was started with (`serve --camera NAME=FILE`; GET "
        "/model has them under `cameras`): the image is warped into the model's camera, and the "
        "distances are those of its car. Not together with X-Camera-Fov-Y.",
        NAME,
    ),
    FIELD_OF_VIEW: (
        "Vertical field of view of the image, degrees; default: that of the model's camera. A "
        "larger one is cropped to the model's.",
        {"type": "number", "minimum": MIN_FOV_DEG, "maximum": MAX_FOV_DEG},
    ),
    REQUEST_ID: (
        "Returned in a header of the same name, and written to the log. A value that is not "
        f"printable ASCII of at most {MAX_NAME} characters is replaced by a new one.",
        {"type": "string"},
    ),
}


def image_parameters() -> list[dict[str, Any]]:
    """OpenAPI parameters: the request headers of an image, and the same options in the query."""
    common = {"in": "header", "required": False}
    found = [
        {"name": name, **common, "description": text, "schema": schema}
        for name, (text, schema) in HEADERS.items()
    ]
    for name, header in OPTIONS.items():
        text = f"As the header {header}, which may not be sent then."
        schema = HEADERS[header][1]
        found.append({**common, "in": "query", "name": name, "description": text, "schema": schema})
    return found


def features_operation() -> dict[str, Any]:
    """OpenAPI operation of POST /features, which bypasses FastAPI."""
    schema = {"$ref": "#/components/schemas/Features"}
    return {
        "summary": "Track features of one driver-view image",
        "operationId": "features",
        "parameters": image_parameters(),
        "requestBody": {
            "required": True,
            "description": "The bytes of one JPEG or PNG file: no form, no base64. At most 4 MiB, "
            "16 to 4096 px a side, 8.4 million px. A wider image is cropped to the model's view; "
            "an image that does not contain this view is refused.",
            "content": {
                name: {"schema": {"type": "string", "format": "binary", "contentMediaType": name}}
                for name in MEDIA_TYPES
            },
        },
        "responses": {
            "200": {
                "description": "The track features, in the media type that `Accept` prefers",
                "content": {form.media_type: {"schema": schema} for form in FORMATS},
                "headers": {REQUEST_ID: {"schema": NAME}},
            },
            **{str(k): v for k, v in problem_responses(*REFUSALS).items()},
        },
    }


def problem_responses(*types: ProblemType) -> dict[int | str, dict[str, Any]]:
    """OpenAPI responses of a route that can be refused with these problems."""
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
    """Add the refusals that any request may get to an operation's own responses."""
    types = (*SERVER_REFUSALS, *AUTHORIZATION_REFUSALS) if needs_token else SERVER_REFUSALS
    responses = operation["responses"]
    for status, response in problem_responses(*types).items():
        own = responses.get(str(status))
        if own is not None:
            response["description"] = f"{own['description']}; {response['description']}"
        responses[str(status)] = response


def install_openapi(app: FastAPI, public: Collection[str], token_required: bool) -> None:
    """Complete the OpenAPI document of `app` with the paths and schemas that FastAPI lacks.

    `public`: the paths that need no token.
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
            if token_required and path not in public:
                operation["security"] = [{"token": []}]
