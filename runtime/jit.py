"""Where compiled machine code is kept on disk: a folder for each state of a package's sources.

numba's own cache only sees the file of the outermost function: after a change in a function that it
calls from another file, the old machine code would go on being used.
"""

import atexit
import functools
import hashlib
import os
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

OWN_MODE = 0o700
UNUSED_DAYS = 30.0  # after which the code of other sources is deleted


def code_folder(name: str, package: Path) -> Path:
    """A folder that can be written to, for the machine code of all of a package's sources.

    Below `$NUMBA_CACHE_DIR` or the user's cache folder, else a new temporary one that goes when
    the process ends; named after `name` and a hash of the sources. What was not used for a month
    goes. What lies in the folder is unpickled and run: so it must be the user's own, and nobody
    else's to write to. A temporary folder of a guessable name might be another user's.
    """
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    found = f"{name}-{digest.hexdigest()[:16]}"
    home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    try:
        parent = Path(home) if home else Path.home() / ".cache"
        folder = parent / found
        parent.mkdir(parents=True, exist_ok=True)
        if _make_own(folder):
            os.utime(folder)
            _forget_unused(parent, name)
            return folder
    except (OSError, RuntimeError):  # a read-only disk, another user's folder, no home at all
        pass
    temporary = tempfile.mkdtemp(prefix=found)  # of mode 700, and a name that nobody can guess
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    return Path(temporary)


def _make_own(folder: Path) -> bool:
    """Make a folder for this user alone, or take one; False: it is another's, or a link."""
    with suppress(FileExistsError):
        folder.mkdir(mode=OWN_MODE)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        return False
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):  # others may have put code into it
        shutil.rmtree(folder)
        folder.mkdir(mode=OWN_MODE)
    folder.chmod(OWN_MODE)
    return os.access(folder, os.W_OK)


def _forget_unused(parent: Path, name: str) -> None:
    since = time.time() - UNUSED_DAYS * 86_400
    for folder in parent.glob(f"{name}-{'[0-9a-f]' * 16}"):
        try:
            if folder.stat().st_mtime < since:
                shutil.rmtree(folder, ignore_errors=True)
        except OSError:  # another process was quicker
            continue


Function = TypeVar("Function", bound=Callable[..., Any])


@functools.cache
def _cache_folder(package: str) -> str:
    """The folder for the machine code of a package, chosen when its first function is decorated."""
    # Not at its first call: numba's Cache.__init__ opens the folder of the time of decoration.
    return str(code_folder("driverview", Path(str(sys.modules[package].__file__)).parent))


def compiled(function: Function) -> Function:
    """Compile `function` with numba in no-python mode, keeping its type for the type checker.

    Without fast-math: it would let the compiler reorder sums, and two builds of the same kernel
    could then differ in the last bit. Every recording and replay relies on them being equal.
    """
    return _compiled(function, nogil=False)


def compiled_for_threads(function: Function) -> Function:
    """Like `compiled`; the function releases the GIL, so that threads run it at the same time."""
    return _compiled(function, nogil=True)


def _compiled(function: Function, *, nogil: bool) -> Function:
    vars(numba.config)["CACHE_DIR"] = _cache_folder(function.__module__.partition(".")[0])
    decorate = numba.njit(cache=True, fastmath=False, error_model="numpy", nogil=nogil)
    return cast(Function, decorate(function))
