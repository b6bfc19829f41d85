"""Exit codes, error lines and options of commands."""

import errno
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

import trackfeatures as tf
from runtime.cli import main, options


def run_and_exit(error: BaseException, capsys: pytest.CaptureFixture[str]) -> tuple[object, str]:
    def app() -> None:
        raise error

    with pytest.raises(SystemExit) as exit_:
        main(app)
    return exit_.value.code, capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (tf.UserError("no track 'x'; try 'y'"), "no track 'x'; try 'y'\n"),
        (
            OSError(errno.ENOSPC, "No space left", "round.mcap"),
            "the disk is full: round.mcap; free some space and run the same command again\n",
        ),
        (
            PermissionError(errno.EACCES, "denied", "/out"),
            "no permission to write or read: /out; choose another folder or change its mode\n",
        ),
    ],
)
def test_an_error_is_one_line_and_exit_code_1(
    error: Exception, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_and_exit(error, capsys) == (1, f"error: {line}")


def test_ctrl_c_exits_130_without_a_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_and_exit(KeyboardInterrupt(), capsys) == (130, "interrupted\n")


@dataclass(frozen=True)
class Walk:
    """A configuration with two options; `place` is no option."""

    place: str
    steps: Annotated[int, typer.Option("--count", help="Number of steps.")] = 3
    back: Annotated[bool, typer.Option("--back")] = False


def test_annotated_fields_of_a_dataclass_are_options_with_its_defaults() -> None:
    seen: list[object] = []
    app = typer.Typer()

    @app.command()
    @options(Walk)
    def walk(make: partial[Walk], where: str = "park") -> None:
        """Walk."""
        seen.append(make(place=where))

    for words in ([], ["--count", "7", "--back", "--where", "home"]):
        assert CliRunner().invoke(app, words).exit_code == 0
    assert seen == [Walk("park", 3, False), Walk("home", 7, True)]
    assert CliRunner().invoke(app, ["--place", "x"]).exit_code == 2
    shown = " ".join(CliRunner().invoke(app, ["--help"]).stdout.split())
    assert "Number of steps. [default: 3]" in shown
