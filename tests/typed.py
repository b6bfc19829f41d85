"""Runs a command of the project in this process, which saves the imports of a new one.

Tests of signals, exit and of what libraries print start a process instead.
"""

import contextlib
import io
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from unittest import mock


def typed(*words: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run `words`, a command and its arguments, in `folder`; the output and exit code."""
    arguments = [str(word) for word in words]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.object(sys, "argv", arguments))
        stack.enter_context(contextlib.chdir(folder or Path.cwd()))
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(err))
        try:
            import_module(f"{arguments[0]}.cli").main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0
    return subprocess.CompletedProcess(arguments, code, out.getvalue(), err.getvalue())


def error_line(done: subprocess.CompletedProcess[str]) -> str:
    """The one line with which a command refused; AssertionError for several, or a traceback."""
    assert "Traceback" not in done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, done.stderr
    return errors[0]
