"""Short comparisons for the tests: their configuration, and a count of their drives."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import controllers.compare.run as comparison
from controllers.compare.cells import Cell
from controllers.compare.config import CompareConfig

SHORT = {"tracks": "oval,town", "controllers": "lqr,torcs", "steps": 60}


def short(folder: Path, **changes: Any) -> CompareConfig:
    return CompareConfig(out=folder / "comparison", **{**SHORT, **changes})


class Counter:
    """Stores the cells that are driven; batches have one cell."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, stop_after: int | None = None) -> None:
        self.cells: list[Cell] = []
        real = comparison.drive_cells

        def counted(*arguments: Any) -> Iterator[list[tuple[Cell, comparison.Driven]]]:
            for batch in real(*arguments):
                if len(self.cells) == stop_after:
                    raise KeyboardInterrupt
                self.cells += [cell for cell, _ in batch]
                yield batch

        monkeypatch.setattr("controllers.drive.many.CARS", 1)
        monkeypatch.setattr(comparison, "drive_cells", counted)
