"""The command `simulator watch` as a subprocess: first line, Ctrl-C, one-line errors."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect

from simulator.track.catalogue import OWN_TRACKS
from tests.typed import error_line, typed

COMMAND = [sys.executable, "-m", "simulator", "watch"]


def first_line(process: subprocess.Popen[str]) -> str:
    assert process.stderr is not None
    for text in process.stderr:
        if "://" in text or "error" in text:
            return text
    raise AssertionError("it ended without a word")


@pytest.mark.slow
def test_every_option_is_accepted_and_ctrl_c_ends_it(tmp_path: Path) -> None:
    (tmp_path / "loop.toml").write_bytes((OWN_TRACKS / "town.toml").read_bytes())
    flags = ["--track", "loop", "--tracks-dir", str(tmp_path), "--lanes", "3", "--traffic", "2"]
    flags += ["--light", "overcast", "--host", "127.0.0.1", "--port", "0", "--speed", "3"]
    process = subprocess.Popen(
        [*COMMAND, *flags, "--seed", "5"], stderr=subprocess.PIPE, text=True, cwd=tmp_path
    )
    try:
        found = re.fullmatch(
            r"watch loop at http://127\.0\.0\.1:(\d+) \(Ctrl-C ends it\)\n", first_line(process)
        )
        assert found
        with connect(f"ws://127.0.0.1:{found[1]}/live") as line:
            scene = json.loads(line.recv(timeout=120))
            state: dict[str, Any] = json.loads(line.recv(timeout=120))
            began = time.monotonic()
            process.send_signal(signal.SIGINT)
            process.wait(timeout=120)
            assert time.monotonic() - began < 10.0  # with a browser still there
    finally:
        process.kill()
        process.wait()
    assert (scene["track"], scene["lanes"]) == ("loop", 3)
    assert (len(state["traffic"]), state["light"], state["asked_rate"]) == (2, "overcast", 3.0)
    assert process.returncode == 130
    assert process.stderr is not None
    assert process.stderr.read() == ""
    assert list(tmp_path.iterdir()) == [tmp_path / "loop.toml"]


def run(*flags: str, **environment: str) -> subprocess.CompletedProcess[str]:
    if not environment:
        return typed("simulator", "watch", "--port", "0", *flags)
    return subprocess.run(
        [*COMMAND, "--port", "0", *flags],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env={**os.environ, **environment},
    )


def refusal(done: subprocess.CompletedProcess[str]) -> str:
    """All that a refused command wrote: one line."""
    assert done.returncode == 1
    assert error_line(done) == done.stderr.rstrip("\n")
    return done.stderr


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--track", "nowhere"), "there is no track 'nowhere'"),
        (("--lanes", "5"), "a road of 5 lanes"),
        (("--light", "disco"), "unknown light 'disco'"),
        (("--speed", "0"), "0 times real time"),
        (("--host", "256.1.1.1"), "cannot listen on 256.1.1.1"),
    ],
)
def test_errors_are_one_line(flags: tuple[str, ...], said: str) -> None:
    assert said in refusal(run(*flags))


def test_error_for_a_port_in_use_is_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        said = refusal(run("--port", str(port)))
    assert f"cannot listen on 127.0.0.1 port {port}: Address already in use" in said


def test_error_without_a_renderer_is_one_line() -> None:
    # This variable names the folder in which EGL looks for its drivers.
    said = refusal(run(__EGL_VENDOR_LIBRARY_DIRS="/nowhere", __EGL_VENDOR_LIBRARY_FILENAMES=""))
    assert "no OpenGL 3.3 through EGL" in said
    assert "apt-get install" in said
