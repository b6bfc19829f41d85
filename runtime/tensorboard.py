"""Writes curves for TensorBoard: event files of scalars. It needs the package tensorboard."""

import socket
import time
from contextlib import suppress
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter


class TensorBoardWriter:
    """Writes scalars to a new event file in `folder`. For a training that continues from the step
    `purge_step`, TensorBoard ignores the points from this step on in older files of the folder.

    torch's SummaryWriter is not used: its thread prints a traceback if the disk is full.
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
        """Add one point at `step` to the curve of each name in `values`."""
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
