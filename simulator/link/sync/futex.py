"""Waits until a word of shared memory changes, with Linux's futex, also between processes.

A signal, or a change before the wait began, ends the wait early. Therefore callers check the word
again in a loop.
"""

import ctypes
import platform
import sys
from typing import Final

from simulator.link.errors import LinkError

WAIT, WAKE = 0, 1
ALL_WAITERS: Final = 2**31 - 1
_NUMBERS: Final = {"x86_64": 202, "aarch64": 98, "riscv64": 98, "ppc64le": 221, "s390x": 238}


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


def check_system() -> None:
    """Raises LinkError if this system has no futexes."""
    if not sys.platform.startswith("linux") or platform.machine() not in _NUMBERS:
        raise LinkError(
            f"the shared-memory link needs Linux on {', '.join(_NUMBERS)}, this is "
            f"{sys.platform} on {platform.machine()}; use the Gymnasium environments instead"
        )


def wait(address: int, value: int, seconds: float) -> None:
    """Sleep while the 32-bit word at `address` is `value`, at most `seconds`."""
    limit = _Timespec(int(seconds), int(seconds % 1.0 * 1e9))
    _call(address, WAIT, value, ctypes.byref(limit))


def wake(address: int) -> None:
    """Wake all processes that wait on the word at `address`."""
    _call(address, WAKE, ALL_WAITERS, None)


_syscall = ctypes.CDLL(None).syscall
_number = ctypes.c_long(_NUMBERS.get(platform.machine(), -1))


def _call(address: int, operation: int, value: int, limit: object) -> None:
    _syscall(
        _number,
        ctypes.c_void_p(address),
        ctypes.c_int(operation),
        ctypes.c_uint32(value),
        limit,
        None,
        ctypes.c_int(0),
    )
