"""The one way this project compiles numeric code: numba, cached on disk, without fast-math.

Fast-math would let the compiler reorder sums, and two builds of the same kernel could then differ
in the last bit; every recording and replay relies on them being equal.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

from trackfeatures.machine_code import code_folder

Function = TypeVar("Function", bound=Callable[..., Any])

vars(numba.config)["CACHE_DIR"] = str(code_folder("driverview", Path(__file__).parent))


def compiled(function: Function) -> Function:
    """Compile `function` with numba in no-python mode, keeping its type for the type checker."""
    return cast(Function, numba.njit(cache=True, fastmath=False, error_model="numpy")(function))
