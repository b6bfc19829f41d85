"""The one way this project compiles numeric code: numba, cached on disk, without fast-math.

Fast-math would let the compiler reorder sums, and two builds of the same kernel could then differ
in the last bit; every recording and replay relies on them being equal.

numba's own cache only sees the file of the outermost function: after a change in a function that
it calls from another file, the old machine code would go on being used. So the cache lies in a
folder named after a hash of all of this package's sources.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def _cache_folder() -> Path:
    """`$NUMBA_CACHE_DIR` or the user's cache folder, below it the sources' hash."""
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(source.read_bytes())
    name = f"driverview-{digest.hexdigest()[:16]}"
    home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    for parent in (Path(home) if home else Path.home() / ".cache", Path(tempfile.gettempdir())):
        folder = parent / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return Path(tempfile.mkdtemp(prefix=name))


vars(numba.config)["CACHE_DIR"] = str(_cache_folder())


def compiled(function: Function) -> Function:
    """Compile `function` with numba in no-python mode, keeping its type for the type checker."""
    return cast(Function, numba.njit(cache=True, fastmath=False, error_model="numpy")(function))
