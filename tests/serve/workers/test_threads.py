"""The number of threads with which a worker computes an answer."""

from pathlib import Path

import pytest

from mtlnet.inference.engine import OpenVinoEngine
from serve import launch
from serve.config import Limits
from serve.launch import default_threads
from serve.worker import load
from serve.workers.supervisor import ServicePlan, Supervisor
from serve.workers.worker_process import WorkerTask


@pytest.mark.parametrize(
    ("cores", "int8", "bf16", "workers", "expected"),
    [
        (2, False, False, 1, 2),
        (16, False, False, 1, 2),
        (4, False, False, 2, 2),
        (3, False, False, 2, 1),
        (1, False, False, 1, 1),
        (16, True, False, 1, 1),
        (16, False, True, 1, 1),
    ],
)
def test_default(
    cores: int,
    int8: bool,
    bf16: bool,
    workers: int,
    expected: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(launch, "usable_cores", lambda: cores)
    monkeypatch.setattr(launch, "has_int8", lambda: int8)
    monkeypatch.setattr(launch, "has_bf16", lambda: bf16)
    assert default_threads(workers) == expected


@pytest.mark.parametrize("threads", [1, 2])
def test_a_worker_computes_with_the_threads_of_the_plan(published: Path, threads: int) -> None:
    plan = ServicePlan("run", lambda _: published, 1, Limits(), threads=threads)
    supervisor = Supervisor(plan, [])
    sent = supervisor._task(0).to_json_line().decode()
    task = WorkerTask.from_json_line(sent)
    engine = load(task, task.folder, None)
    assert isinstance(engine, OpenVinoEngine)
    compiled = engine._request.get_compiled_model()
    assert compiled.get_property("INFERENCE_NUM_THREADS") == threads
