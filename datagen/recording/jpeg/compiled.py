"""How this package compiles: numba, without the GIL, kept on disk."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba

from runtime.jit import code_folder


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` in no-python mode."""
    settings = vars(numba.config)
    before = settings["CACHE_DIR"]
    settings["CACHE_DIR"] = _folder()  # read when the function is made: others' is put back
    try:
        made: Callable[..., Any] = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    finally:
        settings["CACHE_DIR"] = before
    return made


@lru_cache(maxsize=1)
def _folder() -> str:
    return str(code_folder("driverview-jpeg", Path(__file__).parent))
