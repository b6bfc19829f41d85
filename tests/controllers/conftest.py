"""Drives whose perception a test provides."""

from collections.abc import Callable
from contextlib import nullcontext

import pytest

from controllers.perception.perceived import Perceive


@pytest.fixture
def perceive_by(monkeypatch: pytest.MonkeyPatch) -> Callable[[Perceive], None]:
    """A function that replaces the perception of every drive of this test."""

    def replace(perceive: Perceive) -> None:
        monkeypatch.setattr(
            "controllers.drive.run.open_perception", lambda *_, **__: nullcontext(perceive)
        )

    return replace
