"""Maps files into memory without keeping a descriptor open, so that any number can be mapped.

Python's own `mmap` keeps a duplicate of the descriptor for the lifetime of the map; mmap(2) does
not need it. A file is unmapped when the last view of it is garbage-collected.
"""

import ctypes
import mmap
import os
import weakref
from functools import lru_cache
from pathlib import Path

MAP_FAILED = ctypes.c_void_p(-1).value


def map_file(path: Path) -> memoryview:
    """Map all bytes of `path` into memory, read-only and shared between processes.

    Raises OSError, or ValueError for an empty file. The file must not be truncated while the view
    exists: reading beyond its end kills the process (SIGBUS).
    """
    with path.open("rb", buffering=0) as stream:
        size = os.fstat(stream.fileno()).st_size
        if not size:
            raise ValueError("0 bytes are too few for an MCAP file")
        address = _libc().mmap(None, size, mmap.PROT_READ, mmap.MAP_SHARED, stream.fileno(), 0)
        if address == MAP_FAILED:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(path))
    array = (ctypes.c_ubyte * size).from_address(address)
    # Not unmapped at exit: other threads can still read, and the system unmaps everything itself.
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
