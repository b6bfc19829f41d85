"""The progress bar of a collection, on stderr."""

from collections.abc import Iterator
from contextlib import contextmanager

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

from datagen import tally


class FramesPerSecond(ProgressColumn):
    """Of the last seconds; at the end of all. Frames there were before (`begun`) do not count."""

    def render(self, task: Task) -> Text:
        speed = task.speed
        if task.finished_time:
            speed = (task.completed - task.fields["begun"]) / task.finished_time
        return Text(f"{speed:.0f} frames/s" if speed else "starting")


@contextmanager
def shown(rounds: int, frames: int, heading: RenderableType = "") -> Iterator[tally.Progress]:
    """A function that takes the counts and shows them, below `heading`, until the block ends."""
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
        if not bar.live.is_started:  # only now: what is refused before it begins shows nothing
            bar.console.print(heading)
            bar.start()
            bar.update(task, begun=done_frames)
        bar.update(task, completed=done_frames, description=f"{done_rounds}/{rounds} rounds")

    try:
        yield update
    finally:
        if bar.live.is_started:
            bar.stop()
