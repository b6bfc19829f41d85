"""What the bar of a collection says of its speed."""

from rich.progress import Progress

from datagen.execution.progress import FramesPerSecond


def test_the_speed_at_the_end_is_that_of_the_frames_recorded_now() -> None:
    bar = Progress(disable=True)
    bar.add_task("", total=1000, begun=800)
    (task,) = bar.tasks
    column = FramesPerSecond()
    assert str(column.render(task)) == "starting"
    task.completed = 1000
    task.finished_time = 4.0
    task.finished_speed = 9999.0  # of the last moments
    assert str(column.render(task)) == "50 frames/s"
