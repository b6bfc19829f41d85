"""The counters of all workers; the fields of the log, and its limit for refusals."""

import json
import logging
import re
import time
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from serve import shared_memory
from serve.config import Limits
from serve.observability import logs
from serve.observability.logs import REFUSALS_PER_S, JsonFormatter
from serve.problems import PROBLEM_TYPES
from tests.serve.conftest import JPEG, Clock, Served, serving

SAMPLE = re.compile(r'^(driverview_\w+)(\{\w+="[^"]*"(?:,\w+="[^"]*")*\})? (\S+)$')


def read(page: bytes) -> dict[str, float]:
    """The samples of a metrics page; every line must be a sample or a comment."""
    found = {}
    for line in page.decode().splitlines():
        if line.startswith("# "):
            assert re.match(r"# (HELP|TYPE) driverview_\w+ \S", line)
            continue
        match = SAMPLE.match(line)
        assert match, line
        found[match[1] + (match[2] or "")] = float(match[3])
    return found


def test_frames_are_counted_by_outcome(service: Served) -> None:
    for _ in range(3):
        service.post(JPEG)
    service.post(b"text")
    service.post(JPEG, X_Deadline_Ms="x")
    reply = service.ask("GET", "/metrics")
    assert reply.headers["content-type"].startswith("text/plain; version=0.0.4")
    found = read(reply.content)
    for outcome, count in (("answered", 3), ("not-an-image", 1), ("invalid-request", 1)):
        assert found[f'driverview_frames_total{{outcome="{outcome}"}}'] == count
    counted = [value for name, value in found.items() if name.startswith("driverview_frames_total")]
    assert len(counted) == len(PROBLEM_TYPES) + 1
    assert sum(counted) == 5
    for stage in ("queue", "decode", "forward", "total"):
        name = f"driverview_{stage}_seconds"
        buckets = [value for key, value in found.items() if key.startswith(f"{name}_bucket")]
        assert buckets == sorted(buckets)
        assert buckets[-1] == found[f"{name}_count"] == 3
        assert 0 < found[f"{name}_sum"] < 30
    assert found["driverview_connections"] == 1
    assert found["driverview_workers"] == 1


def test_each_worker_reports_the_counts_of_all() -> None:
    memory = shared_memory.create_shared_memory(blocks=2)
    with serving(shared=memory) as one, serving(shared=memory, block=1) as two:
        one.post(JPEG)
        two.post(JPEG)
        two.post(b"")
        pages = [read(service.ask("GET", "/metrics").content) for service in (one, two)]
    for page in pages:
        assert page['driverview_frames_total{outcome="answered"}'] == 2
        assert page['driverview_frames_total{outcome="not-an-image"}'] == 1
        assert page["driverview_workers"] == page["driverview_workers_ready"] == 2


@pytest.fixture
def lines(caplog: pytest.LogCaptureFixture) -> Iterator[pytest.LogCaptureFixture]:
    with caplog.at_level(logging.INFO, logger="serve"):
        yield caplog


def test_refusals_are_logged_with_their_request_and_at_a_limited_rate(
    service: Served, lines: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    clock.now_s = time.monotonic()
    monkeypatch.setattr(logs, "time", SimpleNamespace(monotonic=clock))
    service.post(b"", X_Request_Id='my "id"')
    record = lines.records[-1]
    content = json.loads(JsonFormatter().format(record))
    assert content["request"] == 'my "id"'
    assert content["problem"] == "/problems/not-an-image"
    assert (content["status"], content["client"]) == (422, "127.0.0.1")
    service.post(JPEG)
    assert lines.records[-1] is record  # answers are not logged by default
    for _ in range(200):
        service.post(b"")
    assert len(lines.records) == 1  # one line per second for a client
    clock.now_s += 1.0
    service.post(b"")
    assert json.loads(JsonFormatter().format(lines.records[-1]))["suppressed"] == 200
    for number in range(200):
        service.post(b"", X_Forwarded_For=f"10.0.0.{number}")
    refusals = [record for record in lines.records if record.name == "serve.requests"]
    assert len(refusals) == 1 + REFUSALS_PER_S


def test_answers_are_logged_on_request(lines: pytest.LogCaptureFixture) -> None:
    limits = Limits(log_answers=True)
    with serving(limits=limits) as service:
        service.post(JPEG, X_Request_Id="7")
    (answered,) = (record for record in lines.records if record.getMessage() == "answered")
    content = json.loads(JsonFormatter().format(answered))
    assert (content["message"], content["request"], content["status"]) == ("answered", "7", 200)
    assert content["total_ms"] > 0
