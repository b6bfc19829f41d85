"""A command as a user types it, run in this process: no new one has to import everything again.

What the process itself does (signals, its exit, clean stdout of libraries) is for tests that start
one.
"""

import contextlib
import io
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from unittest import mock


def typed(*words: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run `words`, a command and its arguments, in `folder`; what it said, and its exit code."""
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
