"""Returns free memory of the C library's heap to the operating system.

The library alone would keep the memory that hundreds of connections or a few large images needed.
"""

import ctypes
import os
from functools import cache
from pathlib import Path

GROWTH_BYTES = 8 << 20  # growth of resident memory above its minimum that triggers a trim


class HeapTrimmer:
    """Returns free heap memory to the system if resident memory is 8 MiB (GROWTH_BYTES) or more
    above the minimum seen so far."""

    def __init__(self) -> None:
        self._least_bytes = _resident_bytes()

    def __call__(self) -> None:
        """Compare the resident memory with its minimum, and return free heap memory to the system
        if it has grown too much. This takes a few ms, so call it outside the event loop."""
        resident = _resident_bytes()
        self._least_bytes = min(self._least_bytes, resident)
        if resident - self._least_bytes >= GROWTH_BYTES:
            trim_heap()


def trim_heap() -> None:
    """Return the heap's free memory to the system; no effect without `malloc_trim` (glibc)."""
    library = _c_library()
    if hasattr(library, "malloc_trim"):
        library.malloc_trim(0)


@cache
def _c_library() -> ctypes.CDLL:
    return ctypes.CDLL(None)


def _resident_bytes() -> int:
    """Resident memory of this process in bytes; 0 without /proc."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0
