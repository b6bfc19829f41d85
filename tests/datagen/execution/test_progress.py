"""Speed shown by the progress bar of a collection."""

from rich.progress import Progress

from datagen.execution.progress import FramesPerSecond


def test_the_final_speed_counts_only_frames_recorded_in_this_run() -> None:
    bar = Progress(disable=True)
    bar.add_task("", total=1000, begun=800)
    (task,) = bar.tasks
    column = FramesPerSecond()
    assert str(column.render(task)) == "starting"
    task.completed = 1000
    task.finished_time = 4.0
    task.finished_speed = 9999.0  # speed of the last moments, which must not be shown
    assert str(column.render(task)) == "50 frames/s"
