"""What tests of several packages share."""

from pathlib import Path

import pytest


@pytest.fixture
def no_torcs_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Whatever this machine has of TORCS is not found: only the project's own tracks are."""
    monkeypatch.delenv("TORCS_TRACKS", raising=False)
    monkeypatch.setattr("simulator.track.catalogue.SYSTEM_TRACKS", tmp_path / "no-torcs")
