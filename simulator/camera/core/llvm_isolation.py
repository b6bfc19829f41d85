"""Keeps two LLVMs apart that live in one process: Mesa's, which draws, and triton's, torch's.

Mesa makes the symbols of its libLLVM visible to all; a libtriton that is loaded later binds to them
and crashes at import. Loaded first, it keeps its own. So a process that draws may use torch at any
time, as a policy does that learns from the camera.
"""

import ctypes
import importlib.util
import sys
from pathlib import Path


def load_triton_first() -> None:
    """Load triton's library, if triton is installed and not there yet (about 30 ms, no import)."""
    if "triton" in sys.modules:
        return
    spec = importlib.util.find_spec("triton")
    if spec is None or not spec.submodule_search_locations:
        return
    for library in Path(spec.submodule_search_locations[0]).glob("_C/libtriton*.so"):
        ctypes.CDLL(str(library))
