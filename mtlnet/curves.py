"""The losses of a run as it learns: `curves.csv` and TensorBoard."""

import csv
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from torch.utils.tensorboard import SummaryWriter

COLUMNS = (
    "step",
    "elapsed_s",
    "learning_rate",
    "images_per_second",
    "distance_loss",
    "angle_loss",
    "type_loss",
    "total_loss",
)
CURVES = "curves.csv"


class Curves:
    """Appends points to the curves of `run`; points past `step` (of a lost end) are dropped."""

    columns = COLUMNS

    def __init__(self, run: Path, step: int) -> None:
        path = run / CURVES
        kept = [row for row in read_curves(path) if row["step"] <= step]
        self._file = path.open("w", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._file, COLUMNS, lineterminator="\n")
        self._writer.writeheader()
        for row in kept:
            self.write(row, board=False)
        self._board = SummaryWriter(run / "tensorboard", purge_step=step + 1 if step else None)

    def write(self, point: Mapping[str, float], *, board: bool = True) -> None:
        """Add a point with a value for each of `COLUMNS`."""
        self._writer.writerow({**{k: f"{v:.6g}" for k, v in point.items()}, "step": _step(point)})
        self._file.flush()
        if board:
            for name, value in point.items():
                if name != "step":
                    self._board.add_scalar(f"train/{name}", value, _step(point))

    def __enter__(self) -> "Curves":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()
        self._board.close()


def read_curves(path: Path) -> list[dict[str, float]]:
    """The points of a `curves.csv`; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def _step(point: Mapping[str, float]) -> int:
    return int(point["step"])
