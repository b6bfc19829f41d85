"""Where compiled machine code is kept on disk: a folder for each state of a package's sources.

numba's own cache only sees the file of the outermost function: after a change in a function that it
calls from another file, the old machine code would go on being used.
"""

import functools
import hashlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

UNUSED_DAYS = 30.0  # after which the code of other sources is deleted


def code_folder(name: str, package: Path) -> Path:
    """A folder that can be written to, for the machine code of all of a package's sources.

    Below `$NUMBA_CACHE_DIR` or the user's cache folder, else a temporary one; named after `name`
    and a hash of the sources. What was not used for a month goes.
    """
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    found = f"{name}-{digest.hexdigest()[:16]}"
    home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    for parent in (Path(home) if home else Path.home() / ".cache", Path(tempfile.gettempdir())):
        folder = parent / found
        try:
            folder.mkdir(parents=True, exist_ok=True)
            os.utime(folder)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            _forget_unused(parent, name)
            return folder
    return Path(tempfile.mkdtemp(prefix=found))


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
    vars(numba.config)["CACHE_DIR"] = _cache_folder(function.__module__.partition(".")[0])
    return cast(Function, numba.njit(cache=True, fastmath=False, error_model="numpy")(function))
