"""Fixtures: link servers in separate processes, and the compiled C client."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import uuid
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path

import pytest

from simulator.link.client import Link

START_S = 180.0
SHM = Path("/dev/shm")

ANSWER_S = 60.0
"""Default wait (s) for an answer; it is long because other jobs may load the machine."""

Start = Callable[..., "subprocess.Popen[str]"]


def start_server(name: str, *options: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "simulator", "link", "--name", name, *options]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ
    )


def fresh_name() -> str:
    return f"/drvlink-test-{uuid.uuid4().hex[:12]}"


@pytest.fixture(autouse=True)
def patient_clients(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clients in this process have a longer time-out than the default."""
    defaults = Link.__init__.__kwdefaults__
    assert defaults is not None
    monkeypatch.setitem(defaults, "timeout_s", ANSWER_S)


@pytest.fixture
def name() -> Iterator[str]:
    """A link name unique to the test; checks that no segment is left behind."""
    name = fresh_name()
    yield name
    left = SHM / name[1:]
    leaked = left.exists()
    left.unlink(missing_ok=True)
    assert not leaked, f"the segment {name} was left behind"


@pytest.fixture
def server(name: str) -> Iterator[Start]:
    """Starts servers of `name`; servers still running at the end get SIGTERM."""
    with contextlib.ExitStack() as stack:

        def start(*options: str) -> "subprocess.Popen[str]":
            process = start_server(name, *options)
            stack.callback(stop, process)
            return process

        yield start


@pytest.fixture(scope="session")
def oval() -> Iterator[str]:
    """The name of a server in lock step on the oval, with two lanes, for many clients."""
    name = fresh_name()
    process = start_server(name, "--track", "oval", "--lanes", "2", "--seed", "7")
    yield name
    stop(process)
    assert process.returncode == 0
    assert not (SHM / name[1:]).exists()


@pytest.fixture(scope="session")
def lap_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """simulator/link/c/lap.c, compiled without a warning."""
    out = tmp_path_factory.mktemp("lap") / "lap"
    compile_c(Path(str(files("simulator.link").joinpath("c/lap.c"))), out)
    return out


def compile_c(source: Path, out: Path, *options: str) -> None:
    if shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    strict = ["-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2", "-D_GNU_SOURCE"]
    include = f"-I{files('simulator.link').joinpath('c')}"
    command = ["gcc", *strict, include, *options, "-o", str(out), str(source), "-lm"]
    subprocess.run(command, check=True, capture_output=True, text=True)


def stop(process: "subprocess.Popen[str]") -> tuple[str, str]:
    """Stop a server with SIGTERM if it still runs; returns its stdout and stderr."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
    try:
        return process.communicate(timeout=START_S)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
