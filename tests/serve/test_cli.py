"""The command `serve`: a published model on a real port, the first line, shutdown, errors."""

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
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from http.client import HTTPConnection as Connection
from pathlib import Path
from typing import Any

from mtlnet.inference.engine import load_engine
from mtlnet.inference.golden_image import golden_image
from mtlnet.inference.model_card import CARD, read_card
from mtlnet.inference.prediction import decode_outputs
from mtlnet.inference.shipped_models import SHIPPED
from runtime.sockets import bind
from serve.client import Client
from serve.worker import SupervisorConnection, send_ready
from tests.serve.conftest import PATIENCE_S, png, until
from tests.typed import typed

ROOT = Path(__file__).parents[2]


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "serve", *arguments]


@contextmanager
def started(*arguments: str, folder: Path = ROOT) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The running command and its first line; if it still runs at the end, it is killed."""
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
    """The error line of a command, which must exit with code 1 after exactly one line."""
    done = typed("serve", *arguments, folder=folder)
    assert done.returncode == 1, done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1, done.stderr
    return done.stderr


def test_serve_without_options_takes_the_shipped_or_latest_model_until_ctrl_c(
    published: Path,
) -> None:
    taken = str(SHIPPED) if (SHIPPED / CARD).is_file() else "runs/fresh"
    with started("--port", "0", folder=published.parents[1]) as (process, line):
        assert line.startswith("serving default")
        assert taken in line
        Client(address(line)).wait_until_ready(PATIENCE_S)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0
        assert process.stderr is not None
        assert process.stderr.read() == ""


def test_both_workers_behind_one_port_answer_alike_and_log_every_request(published: Path) -> None:
    """The first part of a generated request id identifies the worker."""
    arguments = ("--model", str(published), "--port", "0", "--workers", "2", "--log-answers")
    connections: dict[str, Connection] = {}  # by worker
    requests: dict[str, tuple[str, int]] = {}  # (worker, status) by request id
    answers: list[dict[str, Any]] = []

    def ask(connection: Connection, body: bytes) -> str:
        """Post `body` on a connection; returns the worker that answered."""
        connection.request("POST", "/features", body, {"Content-Type": "image/png"})
        response = connection.getresponse()
        content = json.loads(response.read())
        request_id = response.headers["X-Request-Id"]
        worker = request_id.partition("-")[0]
        requests[request_id] = worker, response.status
        if response.status == 200:
            answers.append({k: v for k, v in content.items() if k != "timing_ms"})
            connections[worker] = connection
        return worker

    engine, image = load_engine(published), png(golden_image(280, 210)[:, :, ::-1])
    with (
        ThreadPoolExecutor(1) as pool,
        started(*arguments) as (process, line),
        ExitStack() as stack,
    ):
        assert "2 workers" in line
        assert str(published) in line
        assert read_card(published).model_hash[:12] in line
        assert f"openvino {engine.precision}" in line
        assert process.stderr is not None
        log = pool.submit(process.stderr.read)
        port = int(address(line).rpartition(":")[2])

        def are_ready() -> bool:
            with closing(Connection("127.0.0.1", port, timeout=PATIENCE_S)) as connection:
                connection.request("GET", "/metrics")
                return b"driverview_workers_ready 2\n" in connection.getresponse().read()

        def have_answered() -> bool:
            # All connections stay open, so the worker with fewer connections accepts the next one.
            connection = Connection("127.0.0.1", port, timeout=PATIENCE_S)
            ask(stack.enter_context(closing(connection)), image)
            return len(connections) == 2

        until(are_ready)
        until(have_answered)
        for worker, connection in connections.items():
            assert ask(connection, image) == worker
            assert ask(connection, b"no image") == worker
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
        lines = [json.loads(text) for text in log.result().splitlines()]
    expected = decode_outputs(engine(golden_image(280, 210))).as_json()
    assert {key: answers[0][key] for key in expected} == expected
    assert answers[0]["model"] == read_card(published).model_hash
    assert all(answer == answers[0] for answer in answers)
    logged = {entry["request"]: entry for entry in lines if "request" in entry}
    assert {name: entry["status"] for name, entry in logged.items()} == {
        name: status for name, (_, status) in requests.items()
    }
    pids = {(worker, logged[name]["pid"]) for name, (worker, _) in requests.items()}
    assert len(pids) == len({pid for _, pid in pids}) == 2


def test_views_are_averaged_also_after_a_reload(published: Path) -> None:
    arguments = ("--model", str(published), "--port", "0", "--views", "2")
    image = golden_image(280, 210)
    image[:, :100] //= 2  # not symmetric
    expected, single = (
        decode_outputs(load_engine(published, views=views)(image)).as_json() for views in (2, 1)
    )
    assert expected != single
    with started(*arguments) as (_process, line):
        assert "and --views 2 at http" in line
        client = Client(address(line))
        client.wait_until_ready(PATIENCE_S)
        for _ in range(2):
            answer = client.features(png(image[:, :, ::-1]))
            assert {key: answer[key] for key in expected} == expected
            port = address(line).rpartition(":")[2]
            done = typed("serve", "reload", "--port", port, folder=ROOT)
            assert done.returncode == 0, done.stderr


def test_the_first_line_says_how_many_threads_compute_an_answer(published: Path) -> None:
    for threads, expected in (("2", " f32 on 2 threads at http"), ("1", " f32 at http")):
        arguments = ("--model", str(published), "--port", "0", "--threads", threads)
        with started(*arguments) as (_process, line):
            assert expected in line.replace("bf16", "f32")


def test_an_unusable_model_is_an_error_of_one_line(published: Path, tmp_path: Path) -> None:
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
    assert "--views 3: give 1, 2 or 6" in refused(
        "--model", str(published), "--port", "0", "--views", "3"
    )


def test_a_taken_port_and_an_unknown_host_are_errors_of_one_line(published: Path) -> None:
    taken = bind("127.0.0.1", 0)
    taken.listen()
    port = str(taken.getsockname()[1])
    message = refused("--model", str(published), "--port", port)
    assert f"port {port}" in message
    assert "in use" in message
    taken.close()
    assert "no.such.host" in refused("--model", str(published), "--host", "no.such.host")


def test_a_faulty_camera_ends_the_command(tmp_path: Path) -> None:
    assert "give NAME=FILE" in refused("--camera", "roof", "--port", "0")
    path = tmp_path / "roof.yaml"
    path.write_text("K: [1, 0, 0, 0, 0, 0, 0, 0, 1]\nD: []\n")
    assert "K is singular" in refused("--camera", f"roof={path}", "--port", "0")


def test_the_supervisor_loads_neither_framework_nor_engine() -> None:
    """The supervisor answers no request, and every worker waits until it has started."""
    code = "import sys, serve.launch; print({'fastapi', 'cv2', 'openvino'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "set()\n", done.stderr


def test_a_ready_worker_excludes_its_modules_from_garbage_collection() -> None:
    """A garbage collection that includes all modules would delay every client."""
    ours, other = socket.socketpair()
    with other:
        send_ready(SupervisorConnection(ours.detach()))
        try:
            assert json.loads(other.recv(1024)) == {"ready": True}
            assert gc.get_freeze_count() > 10_000
        finally:
            gc.unfreeze()
