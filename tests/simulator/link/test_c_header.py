"""The functions of the C header: an observer's torn copies, and calls without a link."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from simulator.link.handshake import ServerInfo, write_header
from simulator.link.layout import segment_size
from simulator.link.segment import create
from tests.simulator.link.conftest import START_S, Start, compile_c
from tests.simulator.link.test_incompatible import INFO

CALLS = ("latest", "step", "reset", "reset_at", "quit")


@pytest.fixture(scope="module")
def observer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("observer") / "observer"
    compile_c(Path(__file__).with_name("observer.c"), out, "-pthread")
    return out


@contextmanager
def silent_server(name: str, info: ServerInfo = INFO) -> Iterator[None]:
    """A server in this process that sends nothing."""
    segment = create(name, segment_size(info.image_width, info.image_height))
    write_header(segment, info)
    segment.publish()
    try:
        yield
    finally:
        segment.close()


def said(observer: Path, task: str, name: str) -> list[str]:
    command = [str(observer), task, name]
    done = subprocess.run(command, capture_output=True, text=True, timeout=START_S)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    return done.stdout.splitlines()


def test_the_latest_message_is_read_again_after_a_torn_copy(observer: Path, name: str) -> None:
    with silent_server(name):
        assert said(observer, "torn", name) == ["latest: 1, ", "number 2, image whole"]


def test_a_torn_copy_of_a_stopped_server_is_an_error(observer: Path, name: str) -> None:
    with silent_server(name):
        error, _ = said(observer, "stopped", name)
    assert error.startswith(f"latest: -1, the server of {name} (process 1234) is running, but has")


def test_calls_without_a_link_are_errors(observer: Path, name: str, server: Start) -> None:
    missing = f"-1, no link {name}: No such file or directory"
    assert said(observer, "unattached", name) == [f"{call}: {missing}" for call in CALLS]
    closed = f"-1, the link {name} is closed; attach again"
    server("--track", "oval")
    for task in ("left", "quit"):
        assert said(observer, task, name) == [f"{call}: {closed}" for call in CALLS]
