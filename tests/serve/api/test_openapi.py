"""The OpenAPI document against the running service, by Schemathesis: requests that follow it and
requests that break it, each answer held to it.

    make api        a thousand requests an operation; `make test` makes a few
"""

import os
from collections.abc import Iterator
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from serve.app import Service
from tests.serve.conftest import FakeEngine, Served, jpeg, outputs, picture, png, serving

EXAMPLES = int(os.environ.get("DRIVERVIEW_API_EXAMPLES", "10"))


def bodies(image: bytes) -> st.SearchStrategy[bytes]:
    """What a schema cannot tell apart: whole images, broken ones and no images at all."""
    broken = st.integers(1, len(image) - 1).map(lambda cut: image[:cut])
    return st.just(image) | broken | st.binary(max_size=200)


schemathesis.openapi.media_type("image/jpeg", bodies(jpeg(picture())))
schemathesis.openapi.media_type("image/png", bodies(png(picture())))
DOCUMENT = Service(FakeEngine(lambda _image: outputs())).framework.openapi()
schema = schemathesis.openapi.from_dict(DOCUMENT)
# 503 is an answer here: the deadline that a request gave itself may have passed.
schema.config.checks.not_a_server_error.expected_statuses = ["2xx", "4xx", "503"]
# 422: no image in the body, or one that a true header makes useless.
schema.config.checks.positive_data_acceptance.expected_statuses = ["2xx", "422", "503"]


@pytest.fixture(scope="module")
def running() -> Iterator[Served]:
    with serving(FakeEngine(lambda _image: outputs())) as service:
        yield service


def test_the_running_service_gives_this_document(running: Served) -> None:
    assert running.ask("GET", "/openapi.json").content == DOCUMENT
    assert {"/features", "/readyz", "/v2/models/track/infer"} < set(DOCUMENT["paths"])


@schema.parametrize()
@settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck))
def test_every_answer_is_as_the_document_says(
    case: schemathesis.Case[Any], running: Served
) -> None:
    response = case.call_and_validate(base_url=running.url)
    assert response.status_code != 500
