"""Gives the OpenGL context of the process to one thread at a time, and never to a forked child.

OpenGL acts on the context that is current in the calling thread. Without a current context its
calls do nothing, without an error: the picture would be black, or the previous picture.
"""

import ctypes
import os
import threading
from collections.abc import Callable
from typing import Final

from trackfeatures.errors import UserError

Current = tuple[int | None, int | None, int | None, int | None]
"""The display, draw surface, read surface and context that are current in a thread."""
NOTHING: Final[Current] = (None, None, None, None)

END_S: Final = 5.0
"""Longest time (s) that the end of the process waits for another thread to finish its picture."""
_DRAW, _READ = 0x3059, 0x305A
_LIBRARY: Final = os.environ.get("GLCONTEXT_LINUX_LIBEGL") or "libEGL.so.1"
"""The EGL library that moderngl's backend loads."""


class ForkedRendererError(UserError):
    """Raised when a forked process draws, if its parent had used OpenGL before the fork."""


FORKED: Final = (
    "this process was forked after its parent had drawn a picture, and OpenGL does not survive a "
    'fork; start it with the method "spawn" or "forkserver", such as AsyncVectorEnv(..., '
    'context="spawn"), SubprocVecEnv(..., start_method="spawn") or '
    'multiprocessing.get_context("spawn"), or start it before the first picture'
)


class ContextError(UserError):
    """Raised if the OpenGL context cannot be made current in this thread."""


class Egl:
    """The EGL calls that get and set the current context. Raises OSError without the library."""

    def __init__(self) -> None:
        library = ctypes.CDLL(_LIBRARY)
        pointer = ctypes.c_void_p
        self._display = library.eglGetCurrentDisplay
        self._surface = library.eglGetCurrentSurface
        self._context = library.eglGetCurrentContext
        self._make_current, self._error = library.eglMakeCurrent, library.eglGetError
        for ask in (self._display, self._surface, self._context):
            ask.restype = pointer
        self._make_current.argtypes = [pointer] * 4

    def current(self) -> Current:
        """Return the display, surfaces and context that are current in this thread."""
        context = self._context()
        if context is None:
            return NOTHING
        return self._display(), self._surface(_DRAW), self._surface(_READ), context

    def give_back(self, own: Current, before: Current) -> None:
        """Make `before` current again in place of `own`, or no context if `before` is NOTHING."""
        self.make_current(before if before is not NOTHING else (own[0], None, None, None))

    def make_current(self, wanted: Current) -> None:
        """Make the context `wanted` current in this thread. Raises ContextError if EGL refuses."""
        if not self._make_current(*wanted):
            raise ContextError(
                "the OpenGL context cannot be made current in this thread (EGL error "
                f"{self._error():#06x}); if another library has a window's context here, draw in "
                "a thread of its own"
            )


class Turns:
    """Gives the OpenGL context to one thread at a time. A `with` block makes the context current in
    its thread; other threads wait until the block ends.

    Blocks may be nested. At the end of the outermost block, the function `free` is called, which
    frees unused OpenGL objects. Then the context that was current before the block is restored,
    because other libraries rely on it. A block costs 0.03 ms on llvmpipe.
    """

    def __init__(self, egl: Egl, own: Current, free: Callable[[], object]) -> None:
        self._egl, self._own, self._free = egl, own, free
        self._before = NOTHING
        self._process = os.getpid()
        self._lock, self._depth = threading.RLock(), 0

    def __enter__(self) -> None:
        if self._inherited:  # a thread of the parent process may have held the lock
            raise ForkedRendererError(FORKED)
        self._lock.acquire()
        try:
            if self._depth == 0:
                self._before = self._egl.current()
                self._egl.make_current(self._own)
        except BaseException:
            self._lock.release()
            raise
        self._depth += 1

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        try:
            if self._depth == 0:
                self._free()
                self._egl.give_back(self._own, self._before)
        finally:
            self._lock.release()

    def free_if_idle(self) -> None:
        """Free unused OpenGL objects: now, or at the end of the open `with` block if there is one.
        The method never waits, so the garbage collector can call it in any thread. In a forked
        child the method does nothing."""
        if not self._inherited and self._lock.acquire(blocking=False):
            try:
                if self._depth == 0:
                    with self:
                        pass
            finally:
                self._lock.release()

    def end(self) -> None:
        """Stop all drawing by other threads at the end of the process, after at most 5 s of waiting
        for the picture that is being drawn. A daemon thread that still ran inside OpenCV when
        CPython stops the threads would abort the process."""
        if not self._inherited:
            self._lock.acquire(timeout=END_S)

    @property
    def _inherited(self) -> bool:
        return self._process != os.getpid()
