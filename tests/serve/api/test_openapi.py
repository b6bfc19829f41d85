"""Compares the OpenAPI document with the running service. Schemathesis sends requests that follow
the document and requests that violate it, and checks every answer against the document.

    make api        a thousand requests for each operation; `make test` sends a few
"""

import os
from collections.abc import Iterator
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from serve.app import Service
from tests.serve.conftest import Served, constant_engine, jpeg, picture, png, serving

EXAMPLES = int(os.environ.get("DRIVERVIEW_API_EXAMPLES", "10"))


def bodies(image: bytes) -> st.SearchStrategy[bytes]:
    """Bodies that a schema cannot describe: complete images, truncated images, other bytes."""
    broken = st.integers(1, len(image) - 1).map(lambda cut: image[:cut])
    return st.just(image) | broken | st.binary(max_size=200)


schemathesis.openapi.media_type("image/jpeg", bodies(jpeg(picture())))
schemathesis.openapi.media_type("image/png", bodies(png(picture())))
DOCUMENT = Service(constant_engine()).framework.openapi()
schema = schemathesis.openapi.from_dict(DOCUMENT)
# 503 is correct for a request whose own deadline has passed.
schema.config.checks.not_a_server_error.expected_statuses = ["2xx", "4xx", "503"]
# 422 is correct if the body is no image, or if a valid header makes the image unusable.
schema.config.checks.positive_data_acceptance.expected_statuses = ["2xx", "422", "503"]


@pytest.fixture(scope="module")
def running() -> Iterator[Served]:
    with serving() as service:
        yield service


def test_the_running_service_gives_this_document(running: Served) -> None:
    assert running.ask("GET", "/openapi.json").content == DOCUMENT
    assert {"/features", "/readyz", "/v2/models/track/infer"} < set(DOCUMENT["paths"])


def references(node: Any) -> Iterator[str]:
    if isinstance(node, dict):
        if isinstance(node.get("$ref"), str):
            yield node["$ref"]
        node = list(node.values())
    if isinstance(node, list):
        for child in node:
            yield from references(child)


def test_the_document_lists_every_operation_and_refusal(running: Served) -> None:
    document = running.ask("GET", "/openapi.json").content
    assert document["openapi"].startswith("3.1")
    for reference in references(document):
        node = document
        for key in reference.removeprefix("#/").split("/"):
            node = node[key]
        assert node
    assert set(document["paths"]) == {
        "/features",
        "/healthz",
        "/readyz",
        "/model",
        "/metrics",
        "/v2",
        "/v2/health/live",
        "/v2/health/ready",
        "/v2/models/track",
        "/v2/models/track/ready",
        "/v2/models/track/infer",
    }
    post = document["paths"]["/features"]["post"]
    assert post["requestBody"]["required"]
    assert set(post["requestBody"]["content"]) == {"image/jpeg", "image/png"}
    refused = {"400", "401", "403", "406", "408", "413", "415", "422", "429", "431", "500", "503"}
    assert set(post["responses"]) == {"200"} | refused
    for status, response in post["responses"].items():
        good = {"application/json", "application/msgpack"}
        kinds = good if status == "200" else {"application/problem+json"}
        assert set(response["content"]) == kinds
    for path in ("/features", "/v2/models/track/infer"):
        for response in document["paths"][path]["post"]["responses"].values():
            assert "X-Request-Id" in response["headers"]
    assert "HTTPValidationError" not in document["components"]["schemas"]
    kinds = document["components"]["schemas"]["ProblemDetails"]["properties"]["type"]["enum"]
    assert "/problems/not-an-image" in kinds


@schema.parametrize()
@settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck))
def test_every_answer_follows_the_document(case: schemathesis.Case[Any], running: Served) -> None:
    response = case.call_and_validate(base_url=running.url)
    assert response.status_code != 500
