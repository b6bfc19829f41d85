"""Free memory of the C library's heap, given back to the system.

What hundreds of connections or some large images have used stays with the process otherwise.
"""

import ctypes
import os
from functools import cache
from pathlib import Path

GROWTH_BYTES = 8 << 20  # of resident memory over its least, for which a trim is worth a try


class HeapTrimmer:
    """Trims the heap while resident memory is larger than it was."""

    def __init__(self) -> None:
        self._least_bytes = _resident_bytes()

    def __call__(self) -> None:
        """Trim if there is anything to gain. Takes a few ms then; for a thread of its own."""
        resident = _resident_bytes()
        self._least_bytes = min(self._least_bytes, resident)
        if resident - self._least_bytes >= GROWTH_BYTES:
            trim_heap()


def trim_heap() -> None:
    """Return the free memory of the heap to the system, where the C library can (glibc)."""
    library = _c_library()
    if hasattr(library, "malloc_trim"):
        library.malloc_trim(0)


@cache
def _c_library() -> ctypes.CDLL:
    return ctypes.CDLL(None)


def _resident_bytes() -> int:
    """Resident memory of this process; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0
