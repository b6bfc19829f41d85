"""Collects the errors that FFmpeg reports while OpenCV decodes a film.

OpenCV hides decoding errors: frames that FFmpeg has patched look like intact frames. FFmpeg reports
the errors only in its log, which by default goes to stderr. All films of a process share this log:
a line belongs to the film that its thread reads, or for whose decoder the thread was started.
"""

import atexit
import ctypes
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from threading import Lock, get_native_id

AV_LOG_ERROR = 16
LINE_BYTES = 512
# Words of messages that do not concern pictures: dash cameras write much other data, and FFmpeg
# reports the end of a stream of unknown size.
HARMLESS = ("SEI", "APP fields", "timescale not set", f"should be {2**64 - 1}")
SIZES = (b"Reinit context to %dx%d", b"sof0: picture: %dx%d")
SIZE = re.compile(r"(?:to|picture:) (\d+)x(\d+)")
BLOCK_PX = 16
PREFIX = re.compile(r"^(?:\[(\S+) @ [^]]+\] )+")  # e.g. "[h264 @ 0x55d0] "
CONVERTER = "swscaler"
THREADS = Path("/proc/self/task")
LogCallback = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_void_p
)


@dataclass
class DecodingErrors:
    """The errors of one film that FFmpeg has reported since the last `forget`. `count` is their
    number, `first` the text of the first error.

    `unconverted`: text of an error in the conversion to RGB, after which OpenCV returns a black
    picture. `size`: coded size (width, height) of later pictures, if a decoder of H.264 or MJPEG
    reports one; OpenCV scales these pictures to the size of the first picture.
    """

    count: int = 0
    first: str = ""
    unconverted: str = ""
    size: tuple[int, int] | None = None
    threads: set[int] = field(default_factory=set)
    """Native ids of the threads whose errors are collected here."""

    @contextmanager
    def opening(self) -> Iterator[None]:
        """Collect here, until the end of `decoding_errors`, the errors of threads that start within
        the context; open the film in it. Other threads wait until one film is open, so that they do
        not claim its threads."""
        with _LOG.opening, self.reading():
            before = _running_threads()
            try:
                yield
            finally:
                _LOG.claim(self, _running_threads() - before)

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Collect here the errors of the calling thread within the context; read a picture in
        it."""
        own = {get_native_id()}
        _LOG.claim(self, own)
        try:
            yield
        finally:
            self.threads -= own

    def forget(self) -> None:
        """Reset all fields, as if FFmpeg had reported no error."""
        self.count, self.first, self.unconverted, self.size = 0, "", "", None

    def new_size(self, shape: tuple[int, ...]) -> tuple[int, int] | None:
        """Return the coded size (width, height) of the present pictures in px if it does not fit
        the first picture, which has the shape `shape` (H, W, 3); else None.

        A coded size fits if it is less than 16 px larger than the picture, because coded sizes are
        rounded up to a multiple of 16 px. It also fits if this is true with width and height
        exchanged, because OpenCV may have rotated the picture.
        """
        if self.size is None:
            return None
        fits = (
            0 <= c - s < BLOCK_PX for c, s in zip(sorted(self.size), sorted(shape[:2]), strict=True)
        )
        return None if all(fits) else self.size

    def add(self, line: str) -> None:
        """Count a line of FFmpeg's log as an error, for example "[h264 @ 0x55d0] Reference 2 >= 2",
        and keep its text in `first` or `unconverted`. Lines that do not concern pictures
        (`HARMLESS`) are ignored."""
        found = PREFIX.match(line)
        text = " ".join(line[found.end() if found else 0 :].split())
        if any(part in text for part in HARMLESS):
            return
        if found and found[1] == CONVERTER:
            self.unconverted = text
        self.first = self.first or text
        self.count += 1


class _Log:
    """The callback for FFmpeg's log, and the collectors that are in use."""

    def __init__(self) -> None:
        self.opening = Lock()
        self._lock = Lock()
        self._used: list[DecodingErrors] = []
        self._callback = LogCallback(self._add)  # FFmpeg can call it as long as the process runs

    def start(self, errors: DecodingErrors) -> None:
        library = _library()
        with self._lock:
            self._used.append(errors)
            if library is not None:
                library.av_log_set_callback(self._callback)

    def end(self, errors: DecodingErrors) -> None:
        with self._lock:
            self._used = [each for each in self._used if each is not errors]
            if not self._used:
                _restore()

    def claim(self, errors: DecodingErrors, threads: set[int]) -> None:
        """Collect in `errors`, and in no other collector, the errors of `threads`."""
        with self._lock:
            for each in self._used:
                each.threads -= threads  # the number of a thread that has ended is used again
            errors.threads |= threads

    def _add(self, context: int, level: int, text: bytes, arguments: int) -> None:
        is_size = level > AV_LOG_ERROR and text.startswith(SIZES)
        library = _library()
        if library is None or (level > AV_LOG_ERROR and not is_size):
            return
        thread = get_native_id()
        found = next((each for each in self._used if thread in each.threads), None)
        if found is None:
            return
        line = ctypes.create_string_buffer(LINE_BYTES)
        library.av_log_format_line(
            ctypes.c_void_p(context), level, text, ctypes.c_void_p(arguments), line, LINE_BYTES,
            ctypes.byref(ctypes.c_int(1)),
        )  # fmt: skip
        told = line.value.decode(errors="replace")
        if not is_size:
            found.add(told)
        elif size := SIZE.search(told):
            found.size = (int(size[1]), int(size[2]))


_LOG = _Log()


@contextmanager
def decoding_errors() -> Iterator[DecodingErrors]:
    """Collect the errors of a film, which is opened within `opening` of the returned collector and
    read within its `reading`. Lines of FFmpeg's log that belong to no film are dropped.

    If FFmpeg's library is not found, no errors are collected.
    """
    errors = DecodingErrors()
    _LOG.start(errors)
    try:
        yield errors
    finally:
        _LOG.end(errors)


def _running_threads() -> set[int]:
    """The native ids of the threads of this process; empty on systems without /proc."""
    return {int(each.name) for each in THREADS.iterdir()} if THREADS.is_dir() else set()


def _restore() -> None:
    library = _library()
    if library is not None:
        library.av_log_set_callback(library.av_log_default_callback)


@lru_cache(maxsize=1)
def _library() -> ctypes.CDLL | None:
    """The library libavutil of FFmpeg that OpenCV has loaded; None if it is not found."""
    import cv2  # noqa: F401  # loads it

    try:
        lines = Path("/proc/self/maps").read_text(errors="surrogateescape").splitlines()
    except OSError:
        return None
    paths = [line.split(maxsplit=5)[-1] for line in lines if "/libavutil" in line]
    if not paths:
        return None
    atexit.register(_restore)  # threads of a decoder may outlive the interpreter
    return ctypes.CDLL(paths[0])
