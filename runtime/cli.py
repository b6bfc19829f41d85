"""How every command of this project ends: its result, or one clear line and a non-zero exit."""

import errno
import json
import os
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer

from trackfeatures.errors import UserError

INTERRUPTED = 130  # the shell's code for a process ended by Ctrl-C


def main(app: Callable[[], object]) -> None:
    """Run `app`; a mistake of the user or of the machine becomes `error: ...` on stderr, exit 1."""
    try:
        app()
    except UserError as error:
        fail(str(error))
    except BrokenPipeError:
        # Whoever read our output left (`| head`): nothing to report, and nothing more to flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        fail(_describe(error))
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        sys.exit(INTERRUPTED)


def fail(message: str) -> None:
    sys.stderr.write(f"error: {message}\n")
    sys.exit(1)


def _describe(error: OSError) -> str:
    where = f": {error.filename}" if error.filename else ""
    if error.errno == errno.ENOSPC:
        return f"the disk is full{where}; free some space and run the same command again"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"no permission to write or read{where}; choose another folder or change its mode"
    return f"{error.strerror or error}{where}"


# How the commands of `datagen` give their results: one line, or JSON on stdout.


AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]


def print_result(content: dict[str, Any], as_json: bool, line: str) -> None:
    sys.stdout.write(f"{json.dumps(content, indent=1) if as_json else line}\n")


def counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
