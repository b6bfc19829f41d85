"""The demo's tables for the terminal: the verdict, and predicted beside true values."""

from rich.console import Console
from rich.table import Table

from controllers.demo.frames import Asked
from controllers.demo.report import LEARNED_RATIO, VERDICT_COLUMNS, Verdict, verdict_cells

WIDTH = 120
"""Columns the tables need; a narrower terminal wraps whole lines, which reads better."""


def print_tables(verdicts: list[Verdict], asked: list[Asked]) -> None:
    """Both tables on standard output."""
    console = Console()
    console = Console(width=max(console.width, WIDTH))
    console.print(_verdict_table(verdicts))
    console.print(_answers_table(asked))


def _verdict_table(verdicts: list[Verdict]) -> Table:
    table = Table(title=f"Rounds of unseen seeds (learned: at most {LEARNED_RATIO} of the mean's)")
    for column in VERDICT_COLUMNS:
        table.add_column(column, justify="left" if column == "feature" else "right")
    for one in verdicts:
        table.add_row(*verdict_cells(one))
    return table


def _answers_table(asked: list[Asked]) -> Table:
    table = Table(
        title="Held-out frames: true, answered (centre: offset from the centre of the lane)"
    )
    columns = ("track", "lanes", "centre (m)", "ml (m)", "mr (m)", "m (m)", "angle (rad)")
    for column in (*columns, "heading"):
        table.add_column(column, no_wrap=True, justify="right")
    for one in asked:
        found = one.answer["distances_m"]
        table.add_row(
            one.track,
            str(one.lanes),
            _pair(one.to_lane_centre, one.answer["to_lane_centre_m"]),
            *(_pair(one.distances[name], found[name]) for name in ("ml", "mr", "m")),
            f"{one.angle:+.3f} {one.answer['angle_rad']:+.3f}",
            f"{one.heading} {one.answered_heading}",
        )
    return table


def _pair(true: float | None, answered: float | None) -> str:
    return " ".join("  -  " if value is None else f"{value:+.2f}" for value in (true, answered))
