"""Code that all commands share: exit codes, the error line, progress bars, the option `--json`.

Results go to stdout; errors, progress and logs go to stderr. Any file name can be printed on any
terminal: characters that the terminal cannot show become escapes, e.g. `caf\\udce9.jpg`.
"""

import errno
import io
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer

from runtime.signals import ended_by_signals
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from rich.progress import Progress

FAILED = 1  # exit code for a UserError or OSError; Typer exits with 2 for a wrong option
INTERRUPTED = 130  # the shell's code for a process ended by Ctrl-C; here also by SIGTERM or SIGHUP

AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]
Views = Annotated[
    int,
    typer.Option(
        help="Number of views of each image whose answers are averaged. 1: the image alone; "
        "2: also its mirror image (errors about a tenth smaller than with 1); 6: also "
        "both of these turned to the left and to the right. The time is proportional to "
        "the number of views."
    ),
]


def main(app: Callable[[], object]) -> None:
    """Run `app`. A UserError or OSError becomes one line `error: ...` on stderr and exit code 1.

    SIGTERM and SIGHUP interrupt `app` as Ctrl-C does: its files are closed, and the exit code is
    130.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # tests and notebooks replace it
            stream.reconfigure(errors="backslashreplace")
    try:
        with ended_by_signals():
            app()
    except UserError as error:
        fail(str(error))
    except BrokenPipeError:
        # The reader of stdout has ended (`| head`): there is nothing to report or to flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(FAILED)
    except OSError as error:
        fail(describe(error))
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        sys.exit(INTERRUPTED)


def fail(message: str) -> None:
    """Write the line `error: MESSAGE` to stderr and exit with code 1."""
    sys.stderr.write(f"error: {printable(message)}\n")
    sys.exit(FAILED)


def print_result(content: dict[str, Any], as_json: bool, line: str) -> None:
    """Print `content` as JSON if `as_json`, else `line`."""
    sys.stdout.write(f"{json.dumps(content, indent=1) if as_json else line}\n")


def progress_bar() -> "Progress":
    """Create a progress bar on stderr that shows the number done and the total number ("3/10"). It
    is erased when its `with` block ends."""
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress

    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    return Progress(*columns, console=Console(stderr=True), transient=True)


@contextmanager
def progress(text: str = "") -> Iterator[Callable[..., None]]:
    """Show a progress bar with `text`. Yields a function that updates the bar. The arguments of the
    function are the number done, the total number and, optionally, a new text."""
    from rich.markup import escape

    with progress_bar() as bar:
        task = bar.add_task(escape(text), total=None)

        def report(done: float, total: float, text: str = text) -> None:
            bar.update(task, completed=done, total=total, description=escape(text))

        yield report


def printable(text: str) -> str:
    """Return `text` with control characters, which file names can contain, as escapes, so that it
    stays one line."""
    return text if text.isprintable() else "".join(map(_printable, text))


def _printable(character: str) -> str:
    control = ord(character) < 32 or 127 <= ord(character) < 160
    return character.encode("unicode_escape").decode() if control else character


def counted(count: int, noun: str) -> str:
    """Return `count` and `noun` as text, with an "s" unless `count` is 1: "1 round", "2 rounds"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def describe(error: OSError) -> str:
    """Return one line that states the error, its file if known, and for common errors a remedy."""
    where = f": {error.filename}" if error.filename else ""
    if error.errno == errno.ENOSPC:
        return f"the disk is full{where}; free some space and run the same command again"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"no permission to write or read{where}; choose another folder or change its mode"
    return f"{error.strerror or error}{where}"
