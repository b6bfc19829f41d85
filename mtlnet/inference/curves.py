"""Reads `curves.csv`, the training curves of a run: losses, task weights, learning rate, speed."""

import math
from pathlib import Path

CURVES = "curves.csv"
COLUMNS = (
    "step",
    "elapsed_s",
    "learning_rate",
    "images_per_second",
    "distance_loss",
    "angle_loss",
    "type_loss",
    "total_loss",
    "distance_weight",
    "angle_weight",
    "type_weight",
)
HEADER = ",".join(COLUMNS) + "\n"


def read_curves(path: Path) -> list[dict[str, float]]:
    """Read a `curves.csv`; returns its rows, each a dict from column name to value. The list is
    empty if the file is missing or has other columns.

    Damaged rows are skipped, because a full disk or a power failure can truncate the last row.
    """
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True)
    if not lines or lines[0] != HEADER:
        return []
    points = (_parse(line) for line in lines[1:] if line.endswith("\n"))
    return [point for point in points if point is not None]


def _parse(line: str) -> dict[str, float] | None:
    try:
        values = [float(text) for text in line.split(",")]
    except ValueError:
        return None
    if len(values) != len(COLUMNS) or not all(map(math.isfinite, values)):
        return None
    return dict(zip(COLUMNS, values, strict=True))
