"""Reload and restart of a running service: no request is lost and no answer is wrong."""

import json
import os
import shutil
import signal
import subprocess
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from mtlnet.inference.engine import load_engine
from mtlnet.inference.golden_image import golden_image
from mtlnet.inference.model_card import read_card
from mtlnet.inference.prediction import decode_outputs
from serve.client import Client
from tests.serve.conftest import PATIENCE_S, png, publish_untrained, until
from tests.serve.test_cli import address, command, refused, started

PAUSE_S = 0.02  # asking all the time takes the cores from the workers that start
BODY = png(golden_image(280, 210)[:, :, ::-1])


@pytest.fixture(scope="module")
def models(published: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The folders of two models with different weights."""
    other = tmp_path_factory.mktemp("other") / "run"
    publish_untrained(other, seed=4)
    return published, other


def expected(run: Path) -> tuple[str, dict[str, Any]]:
    """The hash of a model, and its answer to BODY."""
    return read_card(run).model_hash, decode_outputs(
        load_engine(run)(golden_image(280, 210))
    ).as_json()


class Traffic:
    """Clients that send a request every `PAUSE_S`, with their answers and errors."""

    def __init__(self, url: str, clients: int) -> None:
        self._url = url
        self._stop = threading.Event()
        self.answers: list[dict[str, Any]] = []
        self.faults: list[Exception] = []
        self._threads = [threading.Thread(target=self._drive) for _ in range(clients)]
        for thread in self._threads:
            thread.start()

    def _drive(self) -> None:
        with Client(self._url, timeout_s=PATIENCE_S) as client:
            while not self._stop.wait(PAUSE_S):
                try:
                    self.answers.append(client.features(BODY))
                except Exception as fault:  # noqa: BLE001  # the test looks at them
                    self.faults.append(fault)
                    return

    def end(self) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()


@contextmanager
def traffic(url: str, clients: int = 3) -> Iterator[Traffic]:
    Client(url, timeout_s=PATIENCE_S).wait_until_ready(PATIENCE_S)
    found = Traffic(url, clients)
    try:
        until(lambda: len(found.answers) > 5)
        yield found
    finally:
        found.end()


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    return subprocess.run(
        command(*arguments), capture_output=True, text=True, env=environment, timeout=PATIENCE_S
    )


@pytest.mark.slow
def test_reload_and_restart_lose_no_request_and_give_no_wrong_answer(
    models: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    known = dict(expected(model) for model in models)
    old, new = (read_card(model).model_hash for model in models)
    link = tmp_path / "current"
    link.symlink_to(models[0])
    with started("--model", str(models[0]), "--port", "0", "--workers", "2") as (process, line):
        url = address(line)
        port = url.rpartition(":")[2]
        with traffic(url) as found:
            done = run("reload", "--port", port, "--model", str(models[1]))
            assert done.stdout.strip() == f"now serving model {new[:12]}", done.stderr
            changed = len(found.answers)
            until(lambda: len(found.answers) > changed + 10)
            # Requests sent after the end of the command are answered by the new model.
            assert {a["model"] for a in found.answers[changed + 4 :]} == {new}

            broken = tmp_path / "broken"
            shutil.copytree(models[0], broken)
            with (broken / "model.bin").open("r+b") as file:
                file.write(b"x" * 100)
            done = run("reload", "--port", port, "--model", str(broken))
            assert done.returncode == 1
            assert "damaged" in done.stderr
            assert "old model stays in use" in done.stderr

            done = run("restart", "--port", port)
            assert done.returncode == 0, done.stderr
            changed = len(found.answers)
            until(lambda: len(found.answers) > changed + 10)
            assert found.answers[-1]["model"] == new
        assert found.faults == []
        assert set(Counter(a["model"] for a in found.answers)) == {old, new}
        for answer in found.answers:
            right = known[answer["model"]]
            assert {key: answer[key] for key in right} == right
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0


def test_a_reload_reads_the_cameras_again_for_the_new_model(
    published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The camera's file has no height, so the height is that of the model's camera."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    high, card = tmp_path / "high", json.loads((published / "card.json").read_text())
    shutil.copytree(published, high)
    high_camera = {**card["camera"], "z": card["camera"]["z"] + 0.6}
    (high / "card.json").write_text(json.dumps({**card, "camera": high_camera}))
    roof = tmp_path / "roof.yaml"
    roof.write_text("width: 280\nheight: 210\nfov_y_deg: 67.5\nyaw_deg: 2\n")
    arguments = ("--model", str(published), "--port", "0", "--camera", f"roof={roof}")
    with started(*arguments) as (_process, line), Client(address(line)) as client:
        client.wait_until_ready(PATIENCE_S)
        port = address(line).rpartition(":")[2]

        def height_m() -> Any:
            return client.model()["cameras"]["roof"]["z"]

        assert height_m() == card["camera"]["z"]
        done = run("reload", "--port", port, "--model", str(high))
        assert done.returncode == 0, done.stderr
        assert height_m() == high_camera["z"]
        roof.write_text("fov_y_deg: 10\n")
        done = run("reload", "--port", port, "--model", str(published))
        assert (done.returncode, height_m()) == (1, high_camera["z"])
        assert "the old model stays in use" in done.stderr


def children(pid: int) -> list[int]:
    """The ids of a process's children; `ps` exits with 1 if there are none."""
    command = ["ps", "-o", "pid=", "--ppid", str(pid)]
    found = subprocess.run(command, capture_output=True, text=True)
    return [int(child) for child in found.stdout.split()]


@pytest.mark.slow
def test_sighup_loads_the_folder_again_and_a_dead_worker_is_replaced(
    models: tuple[Path, Path], tmp_path: Path
) -> None:
    current = tmp_path / "current"
    shutil.copytree(models[0], current)
    new = read_card(models[1]).model_hash
    with started("--model", str(current), "--port", "0") as (process, line):
        with Client(address(line), timeout_s=PATIENCE_S) as client:
            client.wait_until_ready(PATIENCE_S)
            shutil.rmtree(current)
            shutil.copytree(models[1], current)
            process.send_signal(signal.SIGHUP)
            until(lambda: client.features(BODY)["model"] == new)
            (worker,) = children(process.pid)
            os.kill(worker, signal.SIGKILL)
            until(lambda: children(process.pid) not in ([], [worker]))
            client.wait_until_ready(PATIENCE_S)
            assert client.features(BODY)["model"] == new
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0


def test_an_open_address_needs_a_token_and_a_command_needs_a_service(
    published: Path, tmp_path: Path
) -> None:
    arguments = ("--model", str(published), "--port", "0")
    for more, said in (
        (("--host", "0.0.0.0"), "set a token"),
        (("--token-file", str(tmp_path / "none")), "no token file"),
    ):
        assert said in refused(*arguments, *more)
    assert "no service of yours on port 1" in refused("reload", "--port", "1")
    (tmp_path / "token").write_text("0123456789abcdef\n")
    with started(*arguments, "--host", "0.0.0.0", "--token-file", str(tmp_path / "token")) as (
        process,
        line,
    ):
        assert "http://0.0.0.0:" in line
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
