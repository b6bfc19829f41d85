"""The command `controllers drive`.

controllers drive --controller mpc --track oval
"""

import json
from typing import TYPE_CHECKING

import typer

from controllers.cli_options import options
from controllers.drive.config import DriveConfig
from runtime import cli as command

if TYPE_CHECKING:
    from controllers.drive.closed_loop import DriveResult


@options(DriveConfig)
def drive(config: DriveConfig, as_json: bool) -> None:
    """Drive a controller in closed loop, from rest 25 m before the start line, and print the score.

    The car stays in gear 1 with a constant throttle, which is reduced behind slower cars. With
    --speed the car holds a speed instead. The score is the sum of the paper's rewards (Li et al.,
    "Reinforcement Learning and Deep Learning based Lateral Control for Autonomous Driving") over
    the number of control steps of --steps. The drive ends early when the car leaves the track,
    turns round, rolls backwards or collides.
    """
    from rich.console import Console

    from controllers.drive.run import check_started
    from controllers.drive.run import drive as run

    with command.progress(f"{config.controller} on {config.track}") as report:
        result = run(config, report)
    check_started(config, result)
    if result.slowed_steps:
        Console(stderr=True).print(
            f"perception was lost for more than 1 s: the car slowed down for "
            f"{result.slowed_steps} steps",
            highlight=False,
        )
    if as_json:
        typer.echo(json.dumps(result.as_json()))
    else:
        _print_table(config, result)


def _print_table(config: DriveConfig, result: "DriveResult") -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    title = f"{config.controller} on {config.track}, perception {config.perception}"
    table = Table(title=escape(title))
    table.add_column("figure")
    table.add_column("value", justify="right")
    for name, value in result.as_json().items():
        table.add_row(name, escape(_cell(value)))
    Console().print(table)
    for name, path in (("log", config.log), ("film", config.video)):
        if path is not None:
            typer.echo(f"{name}: {path}")


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4f}"
    if isinstance(value, list):
        return " to ".join(_cell(part) for part in value)
    return "-" if value is None else str(value)
