"""A recording process: takes rounds from its parent, one after the other, until told to stop.

It lives across rounds because compiled code and the graphics context cost seconds to set up.
"""

import ctypes
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from multiprocessing.connection import Connection

from datagen.round import Job, attempt

PR_SET_PDEATHSIG = 1  # <linux/prctl.h>


def work(connection: Connection, parent: int) -> None:
    """Main function of the process; `parent` is the process that it works for."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which decides
    die_with(parent)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # stdout belongs to the result
    warm_up()
    while True:
        try:
            job: Job | None = connection.recv()
        except EOFError:
            return  # the parent is gone
        if job is None:
            return
        try:
            connection.send(attempt(job, connection.send))
        except BrokenPipeError:
            return


def die_with(parent: int) -> None:
    """No round goes on when its collector was killed: the next one may be recording it already."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        sys.exit(1)


def warm_up() -> None:
    """Load what takes long to load."""
    with _silence():
        import_module("simulator.physics")


@contextmanager
def _silence() -> Iterator[None]:
    """PyBullet greets on stderr when it is loaded: the user has no use for that."""
    kept = os.dup(2)
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)
