"""The commands `controllers compare` and `controllers tune`."""

import json
from typing import Any

import typer

from controllers.cli_options import options
from controllers.compare.config import CompareConfig, TuneConfig
from runtime import cli as command

TERMINAL_WIDTH = 120  # columns that the tables need


@options(CompareConfig)
def compare(config: CompareConfig, as_json: bool) -> None:
    """Drive every controller on every track and print a table of the scores per control step.

    The drives are made as in the paper (Li et al., "Reinforcement Learning and Deep Learning based
    Lateral Control for Autonomous Driving"): on roads with one lane, from a standing start, with
    throttle 0.2 in gear 1. The score of a drive is the sum of the paper's rewards over its control
    steps. To continue an interrupted comparison, run the same command again: it skips the drives
    whose results are in the folder.
    """
    from controllers.compare.report import write_report
    from controllers.compare.run import compare as run

    with command.progress() as progress:
        content = run(config, progress)
    report = write_report(config.out, content)
    if as_json:
        typer.echo(json.dumps(content))
    else:
        _print_scores(content)
        typer.echo(f"report: {report}")


@options(TuneConfig)
def tune(config: TuneConfig, as_json: bool) -> None:
    """Search for the parameters with which controllers get the highest reward.

    Each controller makes the same number of drives. The parameters that were found are written to a
    file, which `controllers drive --parameters` and `controllers compare --parameters` read. To
    continue an interrupted search, run the same command again. "The paper" is Li et al.,
    "Reinforcement Learning and Deep Learning based Lateral Control for Autonomous Driving".
    """
    from controllers.compare.tune import tune as run

    with command.progress() as progress:
        content = run(config, progress)
    if as_json:
        typer.echo(json.dumps(content))
        return
    for name, found in content["controllers"].items():
        values = ", ".join(f"{key} {value:.4g}" for key, value in found["parameters"].items())
        typer.echo(
            f"{name}: {found['reward']:.5f} per step, untuned {found['untuned']:.5f}; "
            f"{values or 'its own parameters'}"
        )
    typer.echo(f"parameters: {config.out}")


def _print_scores(content: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from controllers.compare.report import groups, score_table

    console = Console()
    console = Console(width=max(console.width, TERMINAL_WIDTH))
    for (perception, disturbance), drives in groups(content):
        head, rows = score_table(drives)
        table = Table(title=escape(f"score per step; perception {perception}, {disturbance} added"))
        for title in head:
            table.add_column(escape(title), justify="left" if title == "track" else "right")
        for row in rows:
            table.add_row(*map(escape, row))
        console.print(table)
