"""A file's bytes in memory with no file descriptor held open: any number of rounds stay open.

Python's own `mmap` keeps a duplicate of the descriptor as long as the map lives; the system needs
none. The map goes when the last view of it does. Source: mmap(2).
"""

import ctypes
import mmap
import os
import weakref
from functools import lru_cache
from pathlib import Path

FAILED = ctypes.c_void_p(-1).value


def map_file(path: Path) -> memoryview:
    """All bytes of `path`, read-only, shared with every process that maps it; OSError, ValueError.

    The file must not be cut while the view lives: the system ends a process that reads beyond it.
    """
    with path.open("rb", buffering=0) as stream:
        size = os.fstat(stream.fileno()).st_size
        if not size:
            raise ValueError("0 bytes are too few for an MCAP file")
        address = _libc().mmap(None, size, mmap.PROT_READ, mmap.MAP_SHARED, stream.fileno(), 0)
        if address == FAILED:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(path))
    array = (ctypes.c_ubyte * size).from_address(address)
    # Not at the process's end: threads may still be reading, and the system unmaps all by itself.
    weakref.finalize(array, _libc().munmap, address, size).atexit = False
    return memoryview(array).cast("B").toreadonly()


@lru_cache(maxsize=1)
def _libc() -> ctypes.CDLL:
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype = ctypes.c_void_p
    libc.mmap.argtypes = [
        ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long,
    ]  # fmt: skip
    libc.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]
    return libc
