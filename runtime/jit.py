"""Compiles functions with numba and caches their machine code on disk, in one folder for each
version of a package's sources.

numba's own cache checks only the source file of the outermost function. After a change of a called
function in another file it would still use the old machine code.
"""

import atexit
import functools
import hashlib
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

import numba
from numba.core import cgutils
from numba.extending import intrinsic, register_jitable

OWN_MODE = 0o700
CONTAINED = {"controllers": ("simulator",)}
"""Maps a package to the packages whose functions and constants its compiled code contains. The
package `trackfeatures` is not listed, because the code of every package can contain its
functions."""
UNUSED_DAYS = 30.0  # after this time, unused machine code of other source versions is deleted


def code_folder(name: str, *packages: Path) -> Path:
    """Create or find a writable folder for the machine code of the sources in `packages`.

    The folder is named after `name` and a hash of the sources. It is in `$NUMBA_CACHE_DIR`, or in
    the user's cache folder; if neither is writable, it is a temporary folder that is deleted when
    the process ends. Folders of other versions that were unused for 30 days (UNUSED_DAYS) are
    deleted.

    numba unpickles and executes the files of this folder, so only this user must be able to write
    to it. A temporary folder gets a random name, because another user could create a folder with a
    predictable name first.
    """
    digest = hashlib.sha256()
    for package in packages:
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
    except (OSError, RuntimeError):  # read-only disk, another user's folder, no home
        pass
    temporary = tempfile.mkdtemp(prefix=found)  # mode 700 and a random name
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    return Path(temporary)


def _make_own(folder: Path) -> bool:
    """Create `folder`, or make an existing folder accessible only for this user. Returns False if
    `folder` is a link, belongs to another user or is not writable. An existing folder in which
    other users could write is emptied."""
    with suppress(FileExistsError):
        folder.mkdir(mode=OWN_MODE)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        return False
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):  # others could have written code into it
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
        except OSError:  # another process has deleted it
            continue


Function = TypeVar("Function", bound=Callable[..., Any])
Item = TypeVar("Item")


@functools.cache
def _cache_folder(package: str) -> str:
    """Return the folder for the machine code of a package. It is chosen when the first function of
    the package is decorated."""
    # numba's Cache.__init__ reads the folder at decoration, so the first call would be too late.
    names = (package, *CONTAINED.get(package, ()), "trackfeatures")
    specs = [cast(ModuleSpec, find_spec(name)) for name in names]
    return str(code_folder("driverview", *(Path(str(spec.origin)).parent for spec in specs)))


def compiled(function: Function) -> Function:
    """Compile `function` with numba in no-python mode; its static type stays the same.

    fast-math is off: with it the compiler can reorder sums, and two builds of the same function can
    differ in the last bit. Recordings and replays require equal results.
    """
    return _compiled(function, nogil=False)


def compiled_for_threads(function: Function) -> Function:
    """Compile `function` with numba in no-python mode so that it releases the GIL: threads can run
    it in parallel."""
    return _compiled(function, nogil=True)


def callable_from_compiled(function: Function) -> Function:
    """Make a plain Python function callable from compiled code; Python code calls it unchanged."""
    return register_jitable(function)


class Borrow(Protocol):
    """The type of `borrowed`, which compiled code calls to use an array without reference
    counting."""

    def __call__(self, array: Item) -> Item: ...


def _borrow(typing_context: Any, array: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        null: Any = cgutils.get_null_value
        made = context.make_array(signature.args[0])(context, builder, arguments[0])
        made.meminfo, made.parent = null(made.meminfo.type), null(made.parent.type)
        return made._getvalue()

    return array(array), generate


borrowed: Borrow = cast(Any, intrinsic(_borrow))
"""Returns, in compiled code, the same array without reference counting. With reference counting,
each view of the array causes atomic operations, which take longer than the arithmetic of a small
function. Use `borrowed` only on arguments of a function: its caller keeps them alive until the
function returns."""


def inlined(function: Function) -> Function:
    """Compile a small function of a hot loop with numba. Its machine code is copied into the code
    of each compiled caller, which saves the call and the passing of arrays."""
    return _compiled(function, nogil=False, forceinline=True)


def _compiled(function: Function, *, nogil: bool, forceinline: bool = False) -> Function:
    vars(numba.config)["CACHE_DIR"] = _cache_folder(function.__module__.partition(".")[0])
    decorate = numba.njit(
        cache=True,
        fastmath=False,
        error_model="numpy",
        nogil=nogil,
        forceinline=forceinline,
    )
    return cast(Function, decorate(function))
