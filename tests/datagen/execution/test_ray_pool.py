"""Rounds recorded on a Ray cluster equal those of local processes."""

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import Any

import pytest

from datagen.execution import ray_pool
from datagen.execution.ray_pool import RayPool
from datagen.execution.retry import Timeouts
from datagen.recorder.job import FramesDone, RoundDone
from datagen.recording.folder import read_states
from datagen.recording.integrity.verify import verify
from tests.datagen.commands import SHORT, datagen, datagen_here, make_jobs
from trackfeatures.errors import UserError

pytestmark = pytest.mark.slow


@pytest.mark.extended
def test_two_ray_workers_give_the_same_dataset(collected: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    folder = tmp_path / "data"
    done = datagen(
        "collect", *SHORT, "--out", folder, "--executor", "ray", "--workers", "2", "--json"
    )
    assert done.returncode == 0, done.stderr
    info = json.loads(datagen_here("info", collected, "--json").stdout)
    assert json.loads(done.stdout)["content_hash"] == info["content_hash"]
    for path in sorted((collected / "rounds").iterdir()):
        assert path.read_bytes() == (folder / "rounds" / path.name).read_bytes()
    assert verify(folder, "full").ok
    assert not (folder / ".partial").exists()


@pytest.mark.extended
def test_the_round_of_a_dead_actor_is_retried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ray = pytest.importorskip("ray")
    (temporary := tmp_path / "tmp").mkdir()
    monkeypatch.setenv("RAY_TMPDIR", tempfile.gettempdir())  # Ray's sockets need a short path
    monkeypatch.setenv("TMPDIR", str(temporary))  # of the actors
    monkeypatch.setattr("tempfile.tempdir", str(temporary))  # of this process
    done: list[str] = []
    killed: list[str] = []

    def on_message(message: FramesDone | RoundDone) -> None:
        if isinstance(message, RoundDone):
            done.append(message.state.id)
        elif message.frames and not killed:
            assert list(temporary.glob("datagen-*"))
            killed.append(message.round_id)
            ray.kill(pool._slots[0].actor)

    pool = RayPool(1, on_message, Timeouts(retry_delay_s=0.1))
    assert pool.run(make_jobs(tmp_path, rounds=1, frames=600)) == []
    assert killed == done == ["round-000"] == list(read_states(tmp_path))
    assert not ray.is_initialized()
    assert not list(temporary.glob("datagen-*"))


@pytest.mark.parametrize("address", [None, "ray.example:6379"])
def test_only_a_cluster_that_is_named_is_joined(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, address: str | None
) -> None:
    """A cluster found by chance may belong to another collection and would end with it."""
    ray = pytest.importorskip("ray")
    asked: list[dict[str, Any]] = []

    def init(**options: Any) -> None:
        asked.append(options)
        raise ConnectionError("no answer")

    monkeypatch.setattr(ray, "init", init)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    if address is not None:
        monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(UserError, match=r"no Ray cluster could be joined or started \(no answer\)"):
        RayPool(1, lambda message: None).run(make_jobs(tmp_path, rounds=1, frames=10))
    assert [options["address"] for options in asked] == [address or "local"]
    assert all("num_cpus" not in options for options in asked if address)


def test_the_pool_sleeps_until_a_retry_is_due(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    slept: list[float] = []
    monkeypatch.setattr(ray_pool, "_import_ray", lambda: None)
    monkeypatch.setattr(ray_pool, "sleep", slept.append, raising=False)
    pool = RayPool(1, lambda message: None, Timeouts(retry_delay_s=0.2))
    (job,) = make_jobs(tmp_path, rounds=1, frames=10)
    pool._queue.record_failure(job, "its actor ended", monotonic())
    pool._receive()
    assert 0.0 < slept[0] <= 0.2
    pool._queue.record_failure(job, "its actor ended", monotonic() + 60.0)
    assert pool._queue.take(monotonic() + 1.0) == job
    pool._receive()
    assert slept[1:] == [0.5]


@pytest.mark.extended
def test_a_changed_track_ends_the_collection_at_once(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    (job,) = make_jobs(tmp_path, rounds=1, frames=10)
    changed = replace(job, plan=replace(job.plan, track_hash="0" * 64))
    with pytest.raises(UserError, match="track oval is not the one this dataset was planned with"):
        RayPool(1, lambda message: None).run([changed])
    assert not read_states(tmp_path)
