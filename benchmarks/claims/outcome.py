"""Runs a benchmark as a command and ends it: options, figures as JSON, exit code.

`make bench` reads the exit codes and lists benchmarks that missed a claim or measured nothing.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

REACHED, MISSED, NOT_MEASURED = 0, 1, 3


def run_command(main: Callable[..., None]) -> None:
    """Run `main` as a command with an option for each of its parameters.

    The script's docstring is the help text. A UserError becomes one line on stderr.
    """
    import typer  # imported here, because GPU runs use this module on machines without typer

    from runtime import cli as command

    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.command(help=sys.modules["__main__"].__doc__)(main)
    command.main(app)


def conclude(figures: object, file: Path | None, reached: bool | None) -> NoReturn:
    """Print `figures` as JSON, write them to `file` if it is not None, and exit.

    `reached`: whether the claim was reached; None if it was not measured. The exit code is
    `exit_code(reached)`, or NOT_MEASURED if `reached` is None.
    """
    text = json.dumps(figures, indent=1)
    print(text)
    if file is not None:
        file.write_text(text + "\n")
    sys.exit(NOT_MEASURED if reached is None else exit_code(reached))


def exit_code(reached: bool) -> int:
    """Return the exit code of a benchmark that measured its claim: 0 if the claim was reached, else
    1."""
    return REACHED if reached else MISSED


def not_measured(reason: str) -> NoReturn:
    """Write to stderr why the claim was not measured, and exit with code NOT_MEASURED."""
    sys.stderr.write(f"not measured: {reason}\n")
    sys.exit(NOT_MEASURED)
