"""The command `serve`: a published model on a real port, its first line, its ends, its errors."""

import gc
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mtlnet.inference.engine import load_engine
from mtlnet.inference.model_card import CARD, SHIPPED, golden_image, read_card
from mtlnet.inference.prediction import decode_outputs
from runtime.sockets import bind
from serve.client import Client
from serve.workers.worker import SupervisorConnection, send_ready
from tests.serve.conftest import png
from tests.typed import typed

ROOT = Path(__file__).parents[2]


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "serve", *arguments]


@contextmanager
def started(*arguments: str, folder: Path = ROOT) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The running command and its first line; killed at the end if it still runs."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command(*arguments), stderr=subprocess.PIPE, text=True, cwd=folder, env=environment
    ) as process:
        try:
            assert process.stderr is not None
            yield process, process.stderr.readline()
        finally:
            process.kill()


def address(line: str) -> str:
    found = re.search(r"http://\S+?:\d+", line)
    assert found, line
    return found[0]


def refused(*arguments: str, folder: Path = ROOT) -> str:
    """The one line with which the command ends with exit code 1."""
    done = typed("serve", *arguments, folder=folder)
    assert done.returncode == 1, done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1, done.stderr
    return done.stderr


def test_a_published_model_is_served_and_stops_when_told(published: Path) -> None:
    engine = load_engine(published)
    image = golden_image(280, 210)
    with started("--model", str(published), "--port", "0") as (process, line):
        card = read_card(published)
        assert str(published) in line
        assert card.model_hash[:12] in line
        assert f"openvino {engine.precision}" in line
        with Client(address(line)) as client:
            client.wait_until_ready(120)
            answer = client.features(png(image[:, :, ::-1]))
        expected = decode_outputs(engine(image)).as_json()
        assert {key: answer[key] for key in expected} == expected
        assert answer["model"] == card.model_hash
        process.send_signal(signal.SIGTERM)
        assert process.wait(120) == 0
        assert process.stderr is not None
        assert process.stderr.read() == ""


def test_bare_serve_takes_the_shipped_or_latest_model_and_ctrl_c_ends_it(published: Path) -> None:
    taken = str(SHIPPED) if (SHIPPED / CARD).is_file() else "runs/fresh"
    with started("--port", "0", folder=published.parents[1]) as (process, line):
        assert line.startswith("serving default")
        assert taken in line
        Client(address(line)).wait_until_ready(120)
        process.send_signal(signal.SIGINT)
        assert process.wait(120) == 0


def test_two_workers_give_the_same_answers(published: Path) -> None:
    body = png(golden_image(280, 210))
    with started("--model", str(published), "--port", "0", "--workers", "2") as (process, line):
        assert "2 workers" in line
        answers = set()
        for _ in range(12):  # each connection may meet another worker
            with Client(address(line), timeout_s=120) as client:
                client.wait_until_ready(120)
                answer = client.features(body)
            answers.add(json.dumps({k: answer[k] for k in ("distances_m", "heading", "model")}))
        assert len(answers) == 1
        process.send_signal(signal.SIGTERM)
        assert process.wait(120) == 0


def test_a_damaged_model_is_one_line(published: Path, tmp_path: Path) -> None:
    assert "no run" in refused("--model", str(tmp_path / "none"))
    assert "train" in refused("--model", "latest", folder=tmp_path)
    other = tmp_path / "other"
    shutil.copytree(published, other)
    card = json.loads((other / "card.json").read_text())
    (other / "card.json").write_text(json.dumps({**card, "definitions_version": "0"}))
    assert "version" in refused("--model", str(other), "--port", "0")
    shutil.copy(published / "card.json", other)
    with (other / "model.bin").open("r+b") as file:
        file.seek(1000)
        file.write(b"x" * 100)
    assert "damaged" in refused("--model", str(other), "--port", "0")


def test_a_taken_port_and_an_unknown_host_are_one_line(published: Path) -> None:
    taken = bind("127.0.0.1", 0)
    taken.listen()
    port = str(taken.getsockname()[1])
    message = refused("--model", str(published), "--port", port)
    assert f"port {port}" in message
    assert "in use" in message
    taken.close()
    assert "no.such.host" in refused("--model", str(published), "--host", "no.such.host")


def test_help_loads_nothing_heavy() -> None:
    """Seconds would measure the machine; what is loaded says the same on all of them."""
    code = (
        "import sys; from serve.cli import app; sys.argv[1:] = ['--help']\n"
        "try: app()\n"
        "finally: print({'cv2', 'openvino', 'fastapi', 'torch'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "--workers" in done.stdout
    assert done.stdout.splitlines()[-1] == "set()"


def test_the_supervisor_loads_neither_framework_nor_engine() -> None:
    """It answers no request, and every worker waits for its start."""
    code = "import sys, serve.launch; print({'fastapi', 'cv2', 'openvino'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "set()\n", done.stderr


def test_a_ready_worker_keeps_what_it_loaded_from_the_garbage_collector() -> None:
    """To look through all of it takes so long that every client notices."""
    ours, other = socket.socketpair()
    with other:
        send_ready(SupervisorConnection(ours.detach()))
        try:
            assert json.loads(other.recv(1024)) == {"ready": True}
            assert gc.get_freeze_count() > 10_000
        finally:
            gc.unfreeze()
