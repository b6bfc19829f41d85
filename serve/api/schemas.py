"""The service's answers as schemas, and the parts of its OpenAPI document FastAPI cannot derive."""

from collections.abc import Collection
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel, Field, JsonValue

from serve.api import problems
from serve.api.problems import KINDS, MEDIA_TYPE, Kind
from serve.api.request_options import (
    DEADLINE,
    FIELD_OF_VIEW,
    FORMATS,
    FRAME_ID,
    MAX_FOV_DEG,
    MEDIA_TYPES,
    MIN_FOV_DEG,
    REQUEST_ID,
    STREAM_ID,
)
from serve.config import MAX_DEADLINE_MS, MAX_NAME

PROBLEM_TYPES: list[JsonValue] = [*(kind.type for kind in KINDS), "about:blank"]


class Distances(BaseModel):
    """Signed distances to lane markings in m, left negative; null where a marking is absent."""

    ml: float | None = Field(description="left marking of the car's lane")
    mr: float | None = Field(description="right marking of the car's lane")
    l: float | None = Field(description="next marking left of the one driven on")
    m: float | None = Field(description="marking the car is driving on")
    r: float | None = Field(description="next marking right of the one driven on")


class HeadingProbabilities(BaseModel):
    """How likely the road bends left, goes straight on, bends right; they sum to 1."""

    left: float
    straight: float
    right: float


class Deviations(Distances):
    """Standard deviation of the error of each feature, m and rad; null for what is absent."""

    to_lane_centre: float | None = Field(description="of to_lane_centre_m, m")
    angle: float = Field(description="of angle_rad, rad")


class Timing(BaseModel):
    """Where the service spent its time, ms. `queue` and `total` include receiving the body."""

    queue: float = Field(description="from the first of the request to its turn")
    decode: float
    forward: float
    total: float


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
    std: Deviations | None = Field(
        description="null where the model was published without frames to learn them from"
    )
    out_of_distribution: bool | None = Field(
        description="the image is unlike those the model learned from: do not drive by it"
    )
    model: str = Field(description="hash of the weights that answered")
    definitions_version: str = Field(description="version of what the features mean")
    engine: str
    precision: str
    crop_px: list[int] | None = Field(
        description="left, top, width, height of what the model saw of the image, px; null: all",
        min_length=4,
        max_length=4,
    )
    timing_ms: Timing
    frame_id: str | None = Field(description=f"the request's {FRAME_ID}, null without one")


class Status(BaseModel):
    """How the service is."""

    status: str
    model: str | None = Field(default=None, description="hash of the weights that will answer")


class ProblemDetails(BaseModel):
    """Why there is no answer (RFC 9457)."""

    type: str = Field(
        description="the kind of problem; stable",
        json_schema_extra={"enum": PROBLEM_TYPES},
    )
    title: str
    status: int
    detail: str = Field(description="what was seen and what to do")
    retry_after_ms: int | None = Field(
        default=None, description="when to ask again, ms; only where that may help"
    )


# What any request may meet before its path matters; a probe needs no token and has no rate.
DOOR = (
    problems.MALFORMED,
    problems.TOO_SLOW,
    problems.HEAD_TOO_LARGE,
    problems.TOO_MANY_CONNECTIONS,
)
GUARD = (problems.UNAUTHORIZED, problems.RATE_LIMITED)
REFUSALS = (
    problems.NOT_ACCEPTABLE,
    problems.BODY_TOO_LARGE,
    problems.UNSUPPORTED_TYPE,
    problems.INVALID_REQUEST,
    problems.NOT_AN_IMAGE,
    problems.DAMAGED_IMAGE,
    problems.UNSUPPORTED_IMAGE,
    problems.TRAILING_BYTES,
    problems.IMAGE_SIZE,
    problems.IMAGE_ASPECT,
    problems.FIELD_OF_VIEW,
    problems.INTERNAL,
    problems.NOT_READY,
    problems.OVERLOADED,
    problems.SUPERSEDED,
    problems.DEADLINE_PASSED,
)
NAME: dict[str, Any] = {"type": "string", "maxLength": MAX_NAME, "pattern": "^[ -~]*$"}
HEADERS: dict[str, tuple[str, dict[str, Any]]] = {
    FRAME_ID: ("Comes back as `frame_id`. Printable ASCII.", NAME),
    STREAM_ID: (
        "Names a stream of frames of this client, one camera's for instance: a newer frame takes "
        "the place of one that waits, which is answered 503, `superseded`.",
        NAME,
    ),
    DEADLINE: (
        "A frame whose turn comes later than so many ms after its request began is not decoded, "
        "but answered 503, `deadline-passed`.",
        {"type": "number", "minimum": 0, "maximum": MAX_DEADLINE_MS},
    ),
    FIELD_OF_VIEW: (
        "The image's vertical field of view, degrees; without it, the model's. The model's view is "
        "cut out of a larger one.",
        {"type": "number", "minimum": MIN_FOV_DEG, "maximum": MAX_FOV_DEG},
    ),
    REQUEST_ID: (
        "Comes back in a header of the same name, and stands in the log. One that is not printable "
        f"ASCII of at most {MAX_NAME} characters is replaced by a new one.",
        {"type": "string"},
    ),
}


def header_parameters() -> list[dict[str, Any]]:
    """The headers that speak of an image, as OpenAPI has them."""
    return [
        {"name": name, "in": "header", "required": False, "description": text, "schema": kind}
        for name, (text, kind) in HEADERS.items()
    ]


def features_operation() -> dict[str, Any]:
    """POST /features as OpenAPI has it: that path bypasses the framework."""
    schema = {"$ref": "#/components/schemas/Features"}
    return {
        "summary": "Track features of one driver-view image",
        "operationId": "features",
        "parameters": header_parameters(),
        "requestBody": {
            "required": True,
            "description": "The bytes of one JPEG or PNG file: no form, no base64. At most 4 MiB, "
            "16 to 4096 px a side, 8.4 million px. The model's view is cut out of a wider image; "
            "one that does not hold it is refused.",
            "content": {
                name: {"schema": {"type": "string", "format": "binary", "contentMediaType": name}}
                for name in MEDIA_TYPES
            },
        },
        "responses": {
            "200": {
                "description": "What the model sees, in the type that `Accept` prefers",
                "content": {form.media_type: {"schema": schema} for form in FORMATS},
                "headers": {REQUEST_ID: {"schema": NAME}},
            },
            **{str(k): v for k, v in problem_responses(*REFUSALS).items()},
        },
    }


def problem_responses(*kinds: Kind) -> dict[int | str, dict[str, Any]]:
    """The `responses` of a route that can fail in these ways."""
    statuses = dict.fromkeys(kind.status for kind in kinds)
    schema = {"$ref": "#/components/schemas/ProblemDetails"}
    return {
        status: {
            "description": "; ".join(kind.title for kind in kinds if kind.status == status),
            "content": {MEDIA_TYPE: {"schema": schema}},
        }
        for status in statuses
    }


def add_door(operation: dict[str, Any], guarded: bool) -> None:
    """Add what the door refuses to an operation's responses, beside what it refuses itself."""
    kinds = (*DOOR, *GUARD) if guarded else DOOR
    responses = operation["responses"]
    for status, response in problem_responses(*kinds).items():
        own = responses.get(str(status))
        if own is not None:
            response["description"] = f"{own['description']}; {response['description']}"
        responses[str(status)] = response


def install_openapi(app: FastAPI, public: Collection[str]) -> None:
    """Give `app` an OpenAPI document with the paths and schemas that it does not know of.

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
            schemas = schema.setdefault("components", {}).setdefault("schemas", {})
            for model in (ProblemDetails, Features):
                found = model.model_json_schema(ref_template="#/components/schemas/{model}")
                schemas.update(found.pop("$defs", {}))
                schemas[model.__name__] = found
            schema["paths"] = {"/features": {"post": features_operation()}, **schema["paths"]}
            for path, item in schema["paths"].items():
                for operation in item.values():
                    add_door(operation, path not in public)
            app.openapi_schema = schema
        return app.openapi_schema

    app.openapi = document  # type: ignore[method-assign]  # FastAPI's documented way to extend it
