"""Logs the losses of a training run to `curves.csv` and TensorBoard."""

import socket
import time
from collections.abc import Iterable, Mapping
from contextlib import closing, suppress
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from mtlnet.inference.curves import COLUMNS, CURVES, HEADER, read_curves
from runtime.files import atomic_write


class CurveLog:
    """Appends points to the curves of `run`; stored points after `step` are dropped first.

    They exist if a run was killed after its last checkpoint.
    """

    columns = COLUMNS

    def __init__(self, run: Path, step: int) -> None:
        path = run / CURVES
        kept = [_row(point) for point in read_curves(path) if point["step"] <= step]
        atomic_write(path, "".join([HEADER, *map(_line, kept)]), fsync=True)
        self._tensorboard = TensorBoardWriter(run / "tensorboard", step + 1 if step else None)
        self._file = path.open("a", newline="", encoding="utf-8")

    def write(self, point: Mapping[str, float]) -> None:
        """Add a point with a value for each of `COLUMNS`."""
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


class TensorBoardWriter:
    """Writes scalars to a new event file in `folder`; earlier points from `purge_step` on are void.

    torch's SummaryWriter writes from a thread, which prints its own traceback on a full disk.
    """

    def __init__(self, folder: Path, purge_step: int | None = None) -> None:
        folder.mkdir(exist_ok=True)
        # TensorBoard reads the files of a folder in the order of their names.
        name = f"events.out.tfevents.{time.time():.6f}.{socket.gethostname()}"
        self._file = (folder / name).open("wb")
        self._records = RecordWriter(self._file)
        self._add(Event(file_version="brain.Event:2"))
        if purge_step is not None:
            self._add(Event(step=purge_step, session_log=SessionLog(status=SessionLog.START)))

    def add(self, step: int, values: dict[str, float]) -> None:
        """Add one point to the curve of each name."""
        scalars = [Summary.Value(tag=tag, simple_value=value) for tag, value in values.items()]
        self._add(Event(step=step, summary=Summary(value=scalars)))

    def _add(self, event: Event) -> None:
        event.wall_time = time.time()
        try:
            self._records.write(event.SerializeToString())
            self._file.flush()
        except OSError as error:
            error.filename = self._file.name
            with suppress(OSError):  # writing the rest of the buffer fails again
                self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()
