"""The losses of a run as it learns: `curves.csv` and TensorBoard."""

import socket
import time
from collections.abc import Iterable, Mapping
from contextlib import closing, suppress
from pathlib import Path
from types import TracebackType

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from mtlnet.inference.curves import COLUMNS, CURVES, HEADER, read_curves
from runtime.files import atomic_write


class Curves:
    """Appends points to the curves of `run`; points past `step` (of a lost end) are dropped."""

    columns = COLUMNS

    def __init__(self, run: Path, step: int) -> None:
        path = run / CURVES
        kept = [_row(point) for point in read_curves(path) if point["step"] <= step]
        atomic_write(path, "".join([HEADER, *map(_line, kept)]).encode(), fsync=True)
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


def _row(point: Mapping[str, float]) -> list[str]:
    return [f"{point[name]:.6g}" if name != "step" else f"{point[name]:.0f}" for name in COLUMNS]


def _line(cells: Iterable[str]) -> str:
    return ",".join(cells) + "\n"


# Event files for TensorBoard, written as each point comes. torch's SummaryWriter writes them from
# a thread: on a full disk that prints a traceback of its own.


class Board:
    """Appends scalars to a new event file in `folder`; points from step `purge` on are void."""

    def __init__(self, folder: Path, purge: int | None = None) -> None:
        folder.mkdir(exist_ok=True)
        # TensorBoard reads the files of a folder in the order of their names.
        name = f"events.out.tfevents.{time.time():.6f}.{socket.gethostname()}"
        self._file = (folder / name).open("wb")
        self._records = RecordWriter(self._file)
        self._add(Event(file_version="brain.Event:2"))
        if purge is not None:
            self._add(Event(step=purge, session_log=SessionLog(status=SessionLog.START)))

    def add(self, step: int, values: dict[str, float]) -> None:
        """Add a point to the curve of each name."""
        scalars = [Summary.Value(tag=tag, simple_value=value) for tag, value in values.items()]
        self._add(Event(step=step, summary=Summary(value=scalars)))

    def _add(self, event: Event) -> None:
        event.wall_time = time.time()
        try:
            self._records.write(event.SerializeToString())
            self._file.flush()
        except OSError as error:
            error.filename = self._file.name
            with suppress(OSError):  # what is left in the buffer fails once more
                self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()
