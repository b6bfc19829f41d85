"""examples/features.c compiles without a warning, and runs with a real and a scripted service."""

import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from serve.config import Limits
from tests.serve.conftest import (
    PATIENCE_S,
    FakeEngine,
    Gate,
    Served,
    jpeg,
    outputs,
    picture,
    png,
    serving,
    until,
)

SOURCE = Path(__file__).parents[3] / "examples" / "features.c"
STRICT = ["-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2"]
BODY = (
    b'{"distances_m":{"ml":-1.5,"mr":null},"angle_rad":-0.25,'
    b'"heading":{"left":0.7,"straight":0.2,"right":0.1},"std":{"ml":9.0,"mr":9.0}}'
)


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = next((found for found in map(shutil.which, ("cc", "gcc", "clang")) if found), None)
    if compiler is None:
        pytest.skip("no C compiler on this machine")
    out = tmp_path_factory.mktemp("c") / "features"
    subprocess.run([compiler, *STRICT, "-o", str(out), str(SOURCE)], check=True)
    return out


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "image.jpg"
    path.write_bytes(jpeg(picture()))
    return path


def ask(
    program: Path, port: int, *images: Path, token: str | None = None, host: str = "127.0.0.1"
) -> subprocess.CompletedProcess[str]:
    words = [str(program), host, str(port), *map(str, images)]
    environment = {} if token is None else {"DRIVERVIEW_TOKEN": token}
    return subprocess.run(
        words, capture_output=True, text=True, timeout=PATIENCE_S, env=environment
    )


def test_it_prints_what_the_service_answers(
    program: Path, service: Served, image: Path, tmp_path: Path
) -> None:
    other, broken = tmp_path / "other.png", tmp_path / "broken.jpg"
    other.write_bytes(png(picture()))
    broken.write_bytes(image.read_bytes()[:900])
    said = "ml -2.000 m mr 2.000 m angle 0.1000 rad class straight"
    done = ask(program, service.port, image, other, broken, image)
    assert done.stdout == f"{image}: {said}\n{other}: {said}\n{image}: {said}\n"
    assert done.returncode == 1
    assert "status 422" in done.stderr
    assert "damaged-image" in done.stderr
    assert ask(program, service.port, image).returncode == 0


def test_absent_markings_are_printed_and_a_token_is_sent(program: Path, image: Path) -> None:
    nan = float("nan")
    engine = FakeEngine(lambda _image: outputs((nan, nan, -3.0, 0.5, 4.0), angle=-0.2))
    with serving(engine, limits=Limits(token="0123456789abcdef")) as service:
        assert "status 401" in ask(program, service.port, image).stderr
        for token in ("0123456789abcdef", " 0123456789abcdef\r\n"):
            done = ask(program, service.port, image, token=token)
            assert "ml absent mr absent angle -0.2000 rad class straight" in done.stdout
        for token in ("", " \n"):
            assert "status 401" in ask(program, service.port, image, token=token).stderr


def test_a_busy_service_is_asked_again(program: Path, image: Path) -> None:
    gate = Gate()
    with serving(gate.engine, limits=Limits(queue=0)) as service:
        first = threading.Thread(target=ask, args=(program, service.port, image))
        first.start()
        assert gate.busy.wait(PATIENCE_S)
        second = subprocess.Popen(
            [program, "127.0.0.1", str(service.port), image], stdout=subprocess.PIPE, text=True
        )
        refusals = 'driverview_frames_total{outcome="overloaded"} '
        until(lambda: f"{refusals}0" not in service.ask("GET", "/metrics").content.decode())
        gate.open.set()
        said, _ = second.communicate(timeout=PATIENCE_S)
        first.join()
    assert "class straight" in said


def refusal(extra: str = "") -> bytes:
    return (
        "HTTP/1.1 503 Service Unavailable\r\ncontent-type: application/problem+json\r\n"
        f"retry-after: 1\r\n{extra}content-length: 2\r\n\r\n{{}}"
    ).encode()


def answer() -> bytes:
    return b"HTTP/1.1 200 OK\r\ncontent-length: %d\r\n\r\n%s" % (len(BODY), BODY)


@contextmanager
def scripted(*replies: bytes | None) -> Iterator[tuple[int, list[float]]]:
    """A server that sends these replies byte by byte; for None it closes the connection.

    Yields its port and the list of the request times in s.
    """
    times: list[float] = []
    listener = socket.create_server(("127.0.0.1", 0))

    def run() -> None:
        connection: socket.socket | None = None
        for reply in replies:
            connection = connection or listener.accept()[0]
            read_request(connection)
            times.append(time.monotonic())
            for byte in reply or b"":
                connection.send(bytes([byte]))
            if reply is None or b"close" in reply:
                connection.close()
                connection = None
        if connection is not None:
            connection.close()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield listener.getsockname()[1], times
    finally:
        thread.join()
        listener.close()


def read_request(connection: socket.socket) -> None:
    received = b""
    while b"\r\n\r\n" not in received:
        received += connection.recv(65536)
    head, _, body = received.partition(b"\r\n\r\n")
    length = int(head.lower().partition(b"content-length: ")[2].split(b"\r\n")[0])
    while len(body) < length:
        body += connection.recv(65536)


def test_it_waits_for_retry_after_and_reconnects(program: Path, image: Path) -> None:
    with scripted(refusal(), None, refusal("connection: close\r\n"), answer()) as (port, times):
        done = ask(program, port, image)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{image}: ml -1.500 m mr absent angle -0.2500 rad class left\n"
    assert len(times) == 4
    assert times[1] - times[0] >= 1.0
    assert times[3] - times[2] >= 1.0


def test_an_unreadable_image_and_an_invalid_reply_are_errors(
    program: Path, tmp_path: Path, image: Path
) -> None:
    assert "not readable" in ask(program, 9, tmp_path / "none.jpg").stderr
    with scripted(
        b"HTTP/1.1 200 OK\r\ncontent-length: 99999999\r\nx: close\r\n\r\n{", answer()
    ) as (
        port,
        _,
    ):
        assert "ml -1.500" in ask(program, port, image).stdout  # the longer reply is not read
    assert subprocess.run([program], capture_output=True).returncode == 2


@pytest.mark.parametrize("listens", ["127.0.0.1", "::1"])
def test_localhost_is_both_loopback_addresses(program: Path, image: Path, listens: str) -> None:
    with serving(host=listens) as service:
        for host in ("localhost", "LOCALHOST", listens):
            done = ask(program, service.port, image, host=host)
            assert (done.returncode, "straight" in done.stdout) == (0, True), done.stderr
    done = ask(program, 1, image, host="no.such.host")
    assert (done.returncode, done.stderr) == (2, "no.such.host: there is no such host\n")
