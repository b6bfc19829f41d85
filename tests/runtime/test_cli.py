"""Exit codes, error lines and options of commands."""

import errno
import signal

import pytest

import trackfeatures as tf
from runtime.cli import main


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


def test_sigterm_ends_a_command_as_ctrl_c_does(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(lambda: signal.raise_signal(signal.SIGTERM))
    assert (exit_.value.code, capsys.readouterr().err) == (130, "interrupted\n")
