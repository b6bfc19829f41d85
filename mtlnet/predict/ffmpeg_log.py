"""What FFmpeg reports while OpenCV decodes a film.

OpenCV hides decoding errors: the frames that FFmpeg patches up look like others. The only place
where they are told is the log of FFmpeg, which else goes to stderr.
"""

import atexit
import ctypes
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

AV_LOG_ERROR = 16
LINE_BYTES = 512
# They are about data beside the picture, which dash cameras write as they like.
HARMLESS = ("SEI", "APP fields", "timescale not set")
PREFIX = re.compile(r"^(?:\[(\S+) @ [^]]+\] )+")  # e.g. "[h264 @ 0x55d0] "
CONVERTER = "swscaler"
LogCallback = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_void_p
)


@dataclass
class DecodingErrors:
    """The number of errors so far, and the text of the first. `unconverted`: that of an error in
    the conversion to RGB, after which OpenCV gives a black picture."""

    count: int = 0
    first: str = ""
    unconverted: str = ""

    def forget(self) -> None:
        """Forget the errors so far."""
        self.count, self.first, self.unconverted = 0, "", ""

    def add(self, line: str) -> None:
        """Count a line of the log, e.g. "[h264 @ 0x55d0] Reference 2 >= 2"."""
        found = PREFIX.match(line)
        text = " ".join(line[found.end() if found else 0 :].split())
        if any(part in text for part in HARMLESS):
            return
        if found and found[1] == CONVERTER:
            self.unconverted = text
        self.first = self.first or text
        self.count += 1


@contextmanager
def decoding_errors() -> Iterator[DecodingErrors]:
    """Collect the errors of all films that are decoded within the context.

    Where FFmpeg's library is not found there are none.
    """
    found = DecodingErrors()
    library = _library()
    if library is None:
        yield found
        return

    def add(context: int, level: int, text: bytes, arguments: int) -> None:
        if level <= AV_LOG_ERROR:
            line = ctypes.create_string_buffer(LINE_BYTES)
            library.av_log_format_line(
                ctypes.c_void_p(context), level, text, ctypes.c_void_p(arguments), line, LINE_BYTES,
                ctypes.byref(ctypes.c_int(1)),
            )  # fmt: skip
            found.add(line.value.decode(errors="replace"))

    callback = LogCallback(add)  # must outlive its use
    library.av_log_set_callback(callback)
    try:
        yield found
    finally:
        _restore()


def _restore() -> None:
    library = _library()
    if library is not None:
        library.av_log_set_callback(library.av_log_default_callback)


@lru_cache(maxsize=1)
def _library() -> ctypes.CDLL | None:
    """The libavutil that OpenCV has loaded; None if there is none."""
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
