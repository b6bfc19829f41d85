"""The command `controllers`. Run: `controllers drive --controller mpc --track oval`."""

import typer

from controllers.compare.cli import compare, tune
from controllers.demo.cli import demo
from controllers.drive.cli import drive
from controllers.record.cli import record
from controllers.rl.cli import train
from runtime import cli as command

app = typer.Typer(add_completion=False, rich_markup_mode="rich", no_args_is_help=True)


@app.callback()
def controllers() -> None:
    """Drive the simulated car with a controller, which receives the true state or a model's answers
    to images."""


for run in (drive, demo, compare, tune, train, record):
    app.command()(run)


def main() -> None:
    command.main(app)
