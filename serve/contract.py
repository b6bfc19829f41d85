"""The service's answers as schemas, and the parts of its OpenAPI document FastAPI cannot derive."""

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel, Field, JsonValue

from serve.gate import MEDIA_TYPES
from serve.problems import KINDS, MEDIA_TYPE, Kind

FRAME_ID = "X-Frame-Id"
MAX_FRAME_ID = 128
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


class Timing(BaseModel):
    """Where the service spent its time, ms. `total` includes receiving the body and waiting."""

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
    model: str = Field(description="hash of the weights that answered")
    definitions_version: str = Field(description="version of what the features mean")
    engine: str
    precision: str
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


IMAGE_REQUEST: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "The bytes of one JPEG or PNG file: no form, no base64. At most 4 MiB, 16 "
        "to 4096 px a side, 8.4 million px; the shape (width / height) of the model's camera.",
        "content": {
            name: {"schema": {"type": "string", "format": "binary", "contentMediaType": name}}
            for name in MEDIA_TYPES
        },
    },
    "parameters": [
        {
            "name": FRAME_ID,
            "in": "header",
            "required": False,
            "description": "Comes back as `frame_id`. Printable ASCII.",
            "schema": {"type": "string", "maxLength": MAX_FRAME_ID, "pattern": "^[ -~]*$"},
        }
    ],
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


def install_openapi(app: FastAPI) -> None:
    """Give `app` an OpenAPI document in which the problem schema can be found."""

    def document() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = get_openapi(
                title=app.title,
                version=app.version,
                description=app.description,
                routes=app.routes,
            )
            schemas = schema.setdefault("components", {}).setdefault("schemas", {})
            schemas["ProblemDetails"] = ProblemDetails.model_json_schema()
            app.openapi_schema = schema
        return app.openapi_schema

    app.openapi = document  # type: ignore[method-assign]  # FastAPI's documented way to extend it
