"""The losses of a run as it learns: `curves.csv` and TensorBoard."""

import math
from collections.abc import Iterable, Mapping
from contextlib import closing
from pathlib import Path
from types import TracebackType

from mtlnet.board import Board
from mtlnet.whole import write_whole

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
CURVES = "curves.csv"


class Curves:
    """Appends points to the curves of `run`; points past `step` (of a lost end) are dropped."""

    columns = COLUMNS

    def __init__(self, run: Path, step: int) -> None:
        path = run / CURVES
        kept = [_row(point) for point in read_curves(path) if point["step"] <= step]
        write_whole(path, "".join([_line(COLUMNS), *map(_line, kept)]).encode())
        self._board = Board(run / "tensorboard", step + 1 if step else None)
        self._file = path.open("a", newline="", encoding="utf-8")

    def write(self, point: Mapping[str, float]) -> None:
        """Add a point with a value for each of `COLUMNS`."""
        self._file.write(_line(_row(point)))
        self._file.flush()
        values = {f"train/{name}": value for name, value in point.items() if name != "step"}
        self._board.add(int(point["step"]), values)

    def __enter__(self) -> "Curves":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with closing(self._board), closing(self._file):
            pass


def read_curves(path: Path) -> list[dict[str, float]]:
    """The points of a `curves.csv`; none where there is no file.

    Damaged rows are left out: a full disk or a power cut can leave half of the last one.
    """
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True)
    if not lines or lines[0] != _line(COLUMNS):
        return []
    points = (_point(line) for line in lines[1:] if line.endswith("\n"))
    return [point for point in points if point is not None]


def _point(line: str) -> dict[str, float] | None:
    try:
        values = [float(text) for text in line.split(",")]
    except ValueError:
        return None
    if len(values) != len(COLUMNS) or not all(map(math.isfinite, values)):
        return None
    return dict(zip(COLUMNS, values, strict=True))


def _row(point: Mapping[str, float]) -> list[str]:
    return [f"{point[name]:.6g}" if name != "step" else f"{point[name]:.0f}" for name in COLUMNS]


def _line(cells: Iterable[str]) -> str:
    return ",".join(cells) + "\n"
