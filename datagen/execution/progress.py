"""Counts the progress of a collection from the executor's messages, and shows it as a bar."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from datagen.planning.plan import RoundPlan
from datagen.recorder.job import FramesDone, RoundDone
from datagen.recording.folder import RoundState


class ProgressCallback(Protocol):
    """Called with the numbers of frames and rounds recorded so far, including the frames and rounds
    of earlier runs."""

    def __call__(self, done_frames: int, done_rounds: int) -> None: ...


@dataclass(frozen=True, slots=True)
class CollectResult:
    """Result of a collection: `rounds` and `frames` in the folder, `recorded_frames` in this run.

    `content_hash` is the SHA-256 over all images and labels of the dataset; None while other shards
    of the plan are missing. `resets` is the number of times that a car was reset onto the road in
    the rounds of this run.
    """

    rounds: int
    frames: int
    seconds: float
    frames_per_second: float
    recorded_frames: int
    resets: int
    out: str
    content_hash: str | None = None


class CollectProgress:
    """Counts finished frames of `rounds`; `states` are those of rounds from earlier runs, by id."""

    def __init__(
        self,
        rounds: Sequence[RoundPlan],
        states: Mapping[str, RoundState],
        progress: ProgressCallback,
    ) -> None:
        self._frames_of = frames_of(rounds, states)
        self.finished = [round_id for round_id in self._frames_of if round_id in states]
        self._before = self._done()
        self._running: dict[str, int] = {}
        self._resets = 0
        self._progress = progress
        progress(self._before, len(self.finished))

    def on_message(self, message: FramesDone | RoundDone) -> None:
        if isinstance(message, FramesDone):
            self._running[message.round_id] = message.frames
        else:
            self._running.pop(message.state.id, None)
            self.finished.append(message.state.id)
            self._resets += message.resets
        self._progress(self._done() + sum(self._running.values()), len(self.finished))

    def result(self, folder: Path, seconds: float, content_hash: str | None) -> CollectResult:
        recorded = self._done() - self._before
        return CollectResult(
            rounds=len(self.finished),
            frames=self._done(),
            seconds=round(seconds, 3),
            frames_per_second=round(recorded / seconds, 2),
            recorded_frames=recorded,
            resets=self._resets,
            out=str(folder),
            content_hash=content_hash,
        )

    def _done(self) -> int:
        return sum(self._frames_of[round_id] for round_id in self.finished)


def frames_of(rounds: Sequence[RoundPlan], states: Mapping[str, RoundState]) -> dict[str, int]:
    """Return the number of frames of each round by id: the planned number or, for a finished round,
    the number in its state. A recovered round has fewer frames than planned."""
    return {e.id: states[e.id].frames if e.id in states else e.frames for e in rounds}


class FramesPerSecond(ProgressColumn):
    """Column of the progress bar: frames per second, over the last 20 s or, at the end, over the
    whole run. Frames from earlier runs (the field `begun` of the task) do not count.
    """

    def render(self, task: Task) -> Text:
        speed = task.speed
        if task.finished_time:
            speed = (task.completed - task.fields["begun"]) / task.finished_time
        return Text(f"{speed:.0f} frames/s" if speed else "starting")


@contextmanager
def progress_bar(
    rounds: int, frames: int, heading: RenderableType = ""
) -> Iterator[ProgressCallback]:
    """Show a bar on stderr, below `heading`, for a collection of `rounds` rounds with `frames`
    frames in total, for the duration of the block.

    Yields the function that updates the bar; the bar appears at the first update.
    """
    bar = Progress(
        TextColumn("[bold]{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f} frames"),
        FramesPerSecond(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        speed_estimate_period=20.0,
    )
    task = bar.add_task(f"0/{rounds} rounds", total=frames, begun=0)

    def update(done_frames: int, done_rounds: int) -> None:
        if not bar.live.is_started:  # not earlier, so that errors before the start print no bar
            bar.console.print(heading)
            bar.start()
            bar.update(task, begun=done_frames)
        bar.update(task, completed=done_frames, description=f"{done_rounds}/{rounds} rounds")

    try:
        yield update
    finally:
        if bar.live.is_started:
            bar.stop()
