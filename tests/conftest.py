"""Fixtures and settings of all tests."""

import os
import signal
import subprocess
from contextlib import suppress
from importlib.util import find_spec
from math import inf
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings


def pytest_configure() -> None:
    """Let SIGINT reach the processes that tests start, also when pytest runs in the background.

    A shell without job control starts background jobs with SIGINT ignored, and children inherit it.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # How long an example takes depends on what else the machine does.
    settings.register_profile("driverview", deadline=None)
    settings.load_profile("driverview")
    # Tests run in parallel on few cores: one thread each, and what asks for more lets them sleep.
    # OpenBLAS's threads spin: two of them take 36 times the processor time for an LQR's gains.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests first, so that no process is left with one at the end. They compute,
    and the service's tests mostly wait: the two kinds take turns, so that the cores stay busy.

    Tests of contacts are skipped where PyBullet is not installed.
    """
    if find_spec("pybullet") is None:
        skip = pytest.mark.skip(reason="PyBullet is not installed: contacts cannot be computed")
        for item in items:
            if item.get_closest_marker("contacts"):
                item.add_marker(skip)
    slow = list(dict.fromkeys(item.path for item in items if item.get_closest_marker("slow")))
    slow.sort(key=lambda path: "e2e" not in path.parts)
    paths = dict.fromkeys(item.path for item in items if item.path not in slow)
    waiting = [path for path in paths if "serve" in path.parts]
    place = {path: 2 * number for number, path in enumerate(slow)}
    place |= {path: 2 * number + 1 for number, path in enumerate(waiting)}
    items.sort(key=lambda item: place.get(item.path, inf))


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist
def pytest_testnodedown(node: Any, error: Any) -> None:
    """Print the exit status of a test process that died: a negative one is a signal's number."""
    if error:
        process = node.gateway._io.popen  # execnet's subprocess.Popen
        with suppress(subprocess.TimeoutExpired):
            process.wait(10.0)
        said = f"\n{node.gateway.id} ended with status {process.returncode}"
        node.config.get_terminal_writer().line(said)


@pytest.fixture
def no_torcs_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Hide the TORCS tracks of this machine: only the project's own tracks are found."""
    monkeypatch.delenv("TORCS_TRACKS", raising=False)
    monkeypatch.setattr("simulator.track.catalogue.SYSTEM_TRACKS", tmp_path / "no-torcs")
