"""What tests of several packages share."""

import os
import signal
from pathlib import Path

import pytest


def pytest_configure() -> None:
    """Ctrl-C reaches the processes that tests start, also where this one began in the background.

    A shell without job control starts those with SIGINT ignored, and children inherit that.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # Torch's threads sleep while they wait: tests run beside each other, on few cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


@pytest.fixture
def no_torcs_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Whatever this machine has of TORCS is not found: only the project's own tracks are."""
    monkeypatch.delenv("TORCS_TRACKS", raising=False)
    monkeypatch.setattr("simulator.track.catalogue.SYSTEM_TRACKS", tmp_path / "no-torcs")
