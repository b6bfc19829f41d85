"""The whole application: readiness, concurrent clients, a full queue, status pages."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from mtlnet.inference.engine import ViewAverage
from serve.app import Service
from serve.shared_memory import create_shared_memory
from tests.serve.conftest import (
    CARD,
    JPEG,
    PATIENCE_S,
    FakeEngine,
    Reply,
    Served,
    assert_problem,
    constant_engine,
    outputs,
    png,
    serving,
    until,
)


def test_a_path_without_a_page_is_a_problem(service: Served) -> None:
    assert_problem(service.ask("GET", "/nothing"), 404, "not-found")


def test_a_service_is_alive_at_once_and_ready_once_its_model_is_warm() -> None:
    gate = threading.Event()
    engine = constant_engine()
    with serving(engine, lambda _engine: gate.wait(PATIENCE_S)) as service:
        assert service.ask("GET", "/healthz").content == {"status": "alive"}
        reply = service.ask("GET", "/readyz")
        assert_problem(reply, 503, "not-ready")
        assert reply.headers["retry-after"] == "1"
        assert_problem(service.post(JPEG), 503, "not-ready")
        gate.set()
        until(lambda: service.ask("GET", "/readyz").status == 200)
        assert service.ask("GET", "/readyz").content["model"] == CARD.model_hash
        assert service.post(JPEG).status == 200


def test_each_of_eight_clients_gets_the_answer_for_its_own_image(
    service: Served, engine: FakeEngine
) -> None:
    """The angle encodes the image's first pixel, so that an answer for another image shows."""
    engine.respond = lambda image: outputs(angle=int(image[0, 0, 0]) / 500)

    def drive(client: int) -> int:
        connection = Served(service.port)
        for frame in range(20):
            level = 10 * client + frame
            body = png(np.full((210, 280), level, np.uint8))
            while (reply := connection.post(body, "image/png")).status != 200:
                assert_problem(reply, 503, "overloaded")
                time.sleep(reply.content["retry_after_ms"] / 1e3)
            assert reply.content["angle_rad"] == pytest.approx(level / 500, abs=1e-5)
        return 20

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(drive, range(8))) == 160
    assert len(engine.images) == 160


def test_frames_that_do_not_fit_into_the_queue_are_refused_at_once(
    service: Served, engine: FakeEngine
) -> None:
    """One frame is processed and four wait: of nine frames five are answered and four refused."""
    gate = threading.Event()

    def respond(_image: Any) -> Any:
        gate.wait(PATIENCE_S)
        return outputs()

    engine.respond = respond

    def post(_number: int) -> Reply:
        reply = Served(service.port).post(JPEG)
        if reply.status == 503:
            refusals.release()
        return reply

    refusals = threading.Semaphore(0)
    with ThreadPoolExecutor(9) as pool:
        replies = pool.map(post, range(9))
        try:
            for _ in range(4):
                assert refusals.acquire(timeout=PATIENCE_S)
            assert service.ask("GET", "/healthz").status == 200  # the event loop is free
        finally:
            gate.set()
        found = list(replies)
    assert sorted(reply.status for reply in found) == [200] * 5 + [503] * 4
    for reply in found:
        if reply.status == 503:
            assert_problem(reply, 503, "overloaded")
            assert reply.headers["retry-after"] == "1"
    assert service.post(JPEG).status == 200


def test_the_model_card_is_served(service: Served) -> None:
    model = service.ask("GET", "/model").content
    assert model["model"] == CARD.model_hash
    assert model["camera"]["fov_y_deg"] == 67.5
    assert model["views"] == 1
    assert model["int8_files"] == {}


def test_the_number_of_views_is_served() -> None:
    with serving(ViewAverage(constant_engine(), 2)) as service:
        assert service.ask("GET", "/model").content["views"] == 2


@pytest.mark.parametrize(
    ("cores", "workers", "single"), [(1, 1, True), (2, 1, False), (3, 2, True), (4, 2, False)]
)
def test_a_worker_without_a_second_core_uses_its_loop_alone(
    monkeypatch: pytest.MonkeyPatch, cores: int, workers: int, single: bool
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _pid: set(range(cores)))
    shared = create_shared_memory(workers + 1)  # the same as the supervisor
    app = Service(constant_engine(), shared=shared)
    assert app.frame_queue.single_core is single
