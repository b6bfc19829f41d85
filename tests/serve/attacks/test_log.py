"""The log under attack: one line per second for each client, and no traceback."""

import asyncio
import gc
import json
import logging
import os
import subprocess
import sys
import time

import pytest

from benchmarks.service_stream_fuzz import run_part
from serve.config import Limits
from serve.observability.logs import ErrorLimit, Interval, JsonFormatter, RefusalLog
from serve.problems import UNAUTHORIZED, Problem
from tests.serve.attacks import attacks
from tests.serve.attacks.conftest import Target, open_count
from tests.serve.conftest import JPEG, PATIENCE_S, FakeEngine, Gate, Served, serving, until


def test_mutated_streams_raise_nothing_and_leave_nothing() -> None:
    _, faults = asyncio.run(run_part(seed=7, part=0, count=1000))
    assert faults == []


@pytest.mark.parametrize("attack", [attacks.strange_headers, attacks.mutated_requests])
def test_no_client_causes_a_500_or_a_traceback(
    service: Served, target: Target, attack: attacks.Attack, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        for connection in attack(target):
            connection.settimeout(0.5)
            received = b""
            try:
                while part := connection.recv(65536):
                    received += part
            except OSError:
                pass
            assert b" 500 " not in received
            connection.close()
        assert service.post(JPEG).status == 200
        gc.collect()
    assert [record.getMessage() for record in caplog.records] == []


def test_a_reply_to_a_client_that_has_left_writes_nothing_to_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    gate = Gate()
    with caplog.at_level(logging.WARNING), serving(gate.engine) as service:
        target = Target(service.port)
        for sent in (
            target.post(JPEG),
            target.post(JPEG, X_Forwarded_For="10.0.0.1") + target.ask(),
            target.post(JPEG, X_Forwarded_For="10.0.0.1") + b"no request\r\n\r\n",
        ):
            connection = target.dial()
            connection.sendall(sent)
            assert gate.busy.wait(PATIENCE_S)
            until(lambda: bool(service.server.guard.working or service.server.guard.refused))
            connection.close()
            until(lambda: open_count(service) == 0)
        gate.open.set()
        until(lambda: not service.server.server_state.tasks)
        assert service.post(JPEG).status == 200
        gc.collect()
    assert [record.getMessage() for record in caplog.records] == []


HOSTILE = "\x80\x9b31m{\"a\": 1}, 'x\u2028'"


@pytest.mark.parametrize(
    ("path", "headers", "problem"),
    [
        ("/features", {"Authorization": HOSTILE}, "unauthorized"),
        ("/model", {"Authorization": "Bearer no"}, "unauthorized"),
        ("/features", {"Origin": f"http://{HOSTILE}"}, "forbidden-origin"),
        ("/", {"Origin": f"http://{HOSTILE}"}, "forbidden-origin"),
        ("/features", {"Host": HOSTILE}, "forbidden-host"),
        ("/healthz", {"Origin": HOSTILE, "X-Request-Id": HOSTILE}, "forbidden-origin"),
    ],
)
def test_refusals_of_token_host_and_origin_are_logged_once_a_second(
    engine: FakeEngine,
    path: str,
    headers: dict[str, str],
    problem: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The line has the number of refusals, and the client's text is escaped."""
    token = None if problem == "forbidden-host" else "0123456789abcdef"
    with serving(engine, limits=Limits(token=token)) as service:
        sent = {name: value.encode("utf-8").decode("latin-1") for name, value in headers.items()}
        with caplog.at_level(logging.INFO):
            begin = time.monotonic()
            for _ in range(20):
                service.ask("POST", path, JPEG, sent)
            seconds = time.monotonic() - begin
            service.app.frames.refusals._clients = Interval()
            service.ask("POST", path, JPEG, sent)
    lines = [JsonFormatter().format(r) for r in caplog.records if r.name == "serve.requests"]
    assert 2 <= len(lines) <= seconds + 2
    found = [json.loads(line) for line in lines]
    assert {line["problem"] for line in found} == {f"/problems/{problem}"}
    assert {line["client"] for line in found} == {"127.0.0.1"}
    assert sum(line.get("suppressed", 0) + 1 for line in found) == 21
    assert all(line.isascii() and line.isprintable() for line in lines)


def test_the_addresses_of_one_client_share_its_line(caplog: pytest.LogCaptureFixture) -> None:
    refusals = RefusalLog()
    with caplog.at_level(logging.INFO):
        for number in range(50):
            refusals.log("1", f"2001:db8::{number:x}", Problem(UNAUTHORIZED, "no token"))
    assert len(caplog.records) == 1


def test_several_workers_share_the_rates_of_the_log(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    workers = [RefusalLog(4) for _ in range(4)]
    with caplog.at_level(logging.INFO):
        for step in range(800):  # 8 s
            now[0] = step / 100
            for refusals in workers:
                refusals.log("1", "192.0.2.1", Problem(UNAUTHORIZED, "no token"))
        assert len(caplog.records) == 8
        caplog.clear()
        for step in range(800, 1600):
            now[0] = step / 100
            for number, refusals in enumerate(workers):
                client = f"10.{step // 250}.{step % 250}.{number}"
                refusals.log("1", client, Problem(UNAUTHORIZED, "no token"))
        assert 72 <= len(caplog.records) <= 90  # ten per second, and the initial burst


def test_the_same_error_is_logged_once_a_second() -> None:
    found = Interval()
    assert [found.passes("a", now) for now in (0.0, 0.5, 0.99, 1.0, 1.5)] == [
        True,
        False,
        False,
        True,
        False,
    ]
    limit = ErrorLimit()

    def record(name: str, level: int = logging.ERROR) -> logging.LogRecord:
        return logging.LogRecord(name, level, "", 0, "%s failed", (), None)

    assert [limit.filter(record("uvicorn.error")) for _ in range(3)] == [True, False, False]
    assert all(limit.filter(record("serve.workers.supervisor")) for _ in range(3))
    assert all(limit.filter(record("serve.requests", logging.INFO)) for _ in range(3))


def test_native_libraries_write_one_line_a_second() -> None:
    """The library of the test is libpng, which writes a line for each damaged PNG."""
    program = """
import os, sys, time
import cv2, numpy as np
from serve.observability import logs
logs.capture_native_lines()
logs.set_up()
whole = cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
for at in range(60, len(whole) - 20):
    damaged = bytearray(whole)
    damaged[at] ^= 255
    cv2.imdecode(np.frombuffer(bytes(damaged), np.uint8), 1)
os.write(2, b"a line\\n" * 1000)
time.sleep(0.5)
sys.stderr.write("python's own\\n")
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, timeout=PATIENCE_S
    )
    lines = done.stderr.decode().splitlines()
    assert done.returncode == 0
    assert lines[-1] == "python's own"
    native = [line for line in lines if "a native library wrote" in line]
    assert len(lines) == len(native) + 1
    assert 1 <= len(native) <= 3
