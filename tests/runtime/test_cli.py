"""How commands end: one clear line and a non-zero exit, whatever went wrong."""

import errno

import pytest

import trackfeatures as tf
from runtime.cli import main


def ends_with(error: BaseException, capsys: pytest.CaptureFixture[str]) -> tuple[object, str]:
    def app() -> None:
        raise error

    with pytest.raises(SystemExit) as exit_:
        main(app)
    return exit_.value.code, capsys.readouterr().err


def test_a_mistake_of_the_user_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    code, said = ends_with(tf.UserError("no track 'x'; try 'y'"), capsys)
    assert (code, said) == (1, "error: no track 'x'; try 'y'\n")


def test_a_full_disk_says_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    code, said = ends_with(OSError(errno.ENOSPC, "No space left", "round.mcap"), capsys)
    assert code == 1
    assert said.startswith("error: the disk is full: round.mcap; free some space")


def test_a_forbidden_folder_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    code, said = ends_with(PermissionError(errno.EACCES, "denied", "/out"), capsys)
    assert code == 1
    assert said.startswith("error: no permission to write or read: /out")


def test_ctrl_c_exits_130_without_a_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    assert ends_with(KeyboardInterrupt(), capsys) == (130, "interrupted\n")
