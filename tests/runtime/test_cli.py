"""Exit codes and error lines of commands."""

import errno

import pytest

import trackfeatures as tf
from runtime.cli import main


def run_and_exit(error: BaseException, capsys: pytest.CaptureFixture[str]) -> tuple[object, str]:
    def app() -> None:
        raise error

    with pytest.raises(SystemExit) as exit_:
        main(app)
    return exit_.value.code, capsys.readouterr().err


def test_a_user_error_is_one_line_and_exit_code_1(capsys: pytest.CaptureFixture[str]) -> None:
    code, message = run_and_exit(tf.UserError("no track 'x'; try 'y'"), capsys)
    assert (code, message) == (1, "error: no track 'x'; try 'y'\n")


def test_a_full_disk_is_reported_with_the_file_and_what_to_do(
    capsys: pytest.CaptureFixture[str],
) -> None:
    code, message = run_and_exit(OSError(errno.ENOSPC, "No space left", "round.mcap"), capsys)
    assert code == 1
    assert message.startswith("error: the disk is full: round.mcap; free some space")


def test_a_missing_permission_is_reported_with_the_folder(
    capsys: pytest.CaptureFixture[str],
) -> None:
    code, message = run_and_exit(PermissionError(errno.EACCES, "denied", "/out"), capsys)
    assert code == 1
    assert message.startswith("error: no permission to write or read: /out")


def test_ctrl_c_exits_130_without_a_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_and_exit(KeyboardInterrupt(), capsys) == (130, "interrupted\n")
