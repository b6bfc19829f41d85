"""HEAD is answered like GET, without the body; methods that are not allowed get 405 and Allow."""

import pytest

from serve.config import Limits
from tests.serve.attacks.conftest import Target, read_rest
from tests.serve.conftest import Served, assert_problem, serving

PATHS = (
    *("/", "/docs", "/console/console.js", "/console/sample-1.jpg", "/openapi.json"),
    *("/healthz", "/readyz", "/model", "/metrics"),
    *("/v2", "/v2/health/live", "/v2/health/ready", "/v2/models/track", "/v2/models/track/ready"),
)
REFUSED = ("/features", "/v2/models/track/infer", "/none", "/v2/models/none", "/stream")
UNLIKE = {"date", "content-length"}  # the page /metrics grows


@pytest.mark.parametrize("path", [*PATHS, *REFUSED])
def test_head_is_get_without_the_body(service: Served, path: str) -> None:
    get, head = service.ask("GET", path), service.ask("HEAD", path)
    assert head.status == get.status
    assert head.status == 200 or path in REFUSED
    assert head.content in (b"", None)
    assert int(head.headers["content-length"]) > 0
    assert {k: v for k, v in head.headers.items() if k not in UNLIKE} == {
        k: v for k, v in get.headers.items() if k not in UNLIKE
    }
    if path not in ("/metrics", "/readyz"):
        assert head.headers["content-length"] == get.headers["content-length"]


def test_requests_after_head_stay_in_step_on_one_connection(service: Served) -> None:
    lines = [f"{m} {p} HTTP/1.1\r\nHost: localhost\r\n" for m, p in (("HEAD", "/"), ("HEAD", "/x"))]
    last = "GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n"
    with Target(service.port).dial() as connection:
        connection.sendall("\r\n".join([*lines, last, ""]).encode())
        received = read_rest(connection)
    first, second, third = received.split(b"HTTP/1.1 ")[1:]
    assert (first[:3], second[:3], third[:3]) == (b"200", b"404", b"200")
    assert first.endswith(b"\r\n\r\n")
    assert second.endswith(b"\r\n\r\n")
    assert third.endswith(b'{"status":"alive"}')


def test_head_without_the_token_and_over_the_rate_has_no_body() -> None:
    token = "a-token-of-some-length"
    with serving(limits=Limits(token=token)) as service:
        for path, status in (("/model", 401), ("/v2", 401), ("/", 200), ("/healthz", 200)):
            reply = service.ask("HEAD", path)
            assert (reply.status, reply.content or None) == (status, None)
        assert service.ask("GET", "/healthz").content == {"status": "alive"}


@pytest.mark.parametrize("method", ["OPTIONS", "POST", "PUT", "DELETE", "PATCH", "TRACE"])
def test_other_methods_are_refused_with_those_that_are_allowed(
    service: Served, method: str
) -> None:
    for path, allowed in (
        ("/healthz", "GET, HEAD"),
        ("/", "GET, HEAD"),
        ("/console/console.js", "GET, HEAD"),
        ("/v2/models/track", "GET, HEAD"),
        ("/openapi.json", "GET, HEAD"),
        *((path, "POST") for path in ("/features", "/v2/models/track/infer") if method != "POST"),
    ):
        reply = service.ask(method, path)
        assert (path, reply.headers["allow"]) == (path, allowed)
        assert_problem(reply, 405, "method-not-allowed")
        assert allowed in reply.content["detail"]
        assert ("error" in reply.content) == path.startswith("/v2")
