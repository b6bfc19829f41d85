"""Logs the losses of a training run to `curves.csv` and TensorBoard."""

from collections.abc import Iterable, Mapping
from contextlib import closing
from pathlib import Path

from mtlnet.inference.curves import COLUMNS, CURVES, HEADER, read_curves
from runtime.files import atomic_write
from runtime.tensorboard import TensorBoardWriter


class CurveLog:
    """Appends points to the loss curves in the folder `run`.

    `step`: number of steps taken before the start. Stored points of later steps are deleted first.
    They exist if the run was killed after its last checkpoint.
    """

    columns = COLUMNS

    def __init__(self, run: Path, step: int) -> None:
        path = run / CURVES
        kept = [_row(point) for point in read_curves(path) if point["step"] <= step]
        atomic_write(path, "".join([HEADER, *map(_line, kept)]), fsync=True)
        self._tensorboard = TensorBoardWriter(run / "tensorboard", step + 1 if step else None)
        self._file = path.open("a", newline="", encoding="utf-8")

    def write(self, point: Mapping[str, float]) -> None:
        """Add a point, a dict with a value for each column of `curves.csv` (`COLUMNS`)."""
        self._file.write(_line(_row(point)))
        self._file.flush()
        values = {f"train/{name}": value for name, value in point.items() if name != "step"}
        self._tensorboard.add(int(point["step"]), values)

    def __enter__(self) -> "CurveLog":
        return self

    def __exit__(self, *_: object) -> None:
        with closing(self._tensorboard), closing(self._file):
            pass


def _row(point: Mapping[str, float]) -> list[str]:
    return [f"{point[name]:.6g}" if name != "step" else f"{point[name]:.0f}" for name in COLUMNS]


def _line(cells: Iterable[str]) -> str:
    return ",".join(cells) + "\n"
