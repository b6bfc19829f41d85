"""Writes images to a video file (MPEG-4, .mp4), and reads the boxes of MP4 files."""

from collections.abc import Iterator
from math import log10
from pathlib import Path
from typing import BinaryIO, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.files import utf8_path
from trackfeatures.errors import UserError

FILM_SUFFIX = ".mp4"
MAX_RATE = 65_535
"""Maximum N of a frame rate N / 10^n of MPEG-4, the form in which OpenCV writes it."""
BOX_HEAD = 8


class Mp4Writer:
    """Writes a film of `fps` images per second to the file `path`.

    The first image sets the film's size. Use the writer as a context manager, which closes the
    file; the film can also be played if an error or Ctrl-C ended the `with` block early. Raises
    UserError if the file cannot be written, at the latest when it is closed.
    """

    def __init__(self, path: Path, fps: float) -> None:
        digits = max(int(log10(MAX_RATE / fps)), 0)
        self._path, self._fps = path, round(fps, digits)
        self._film: cv2.VideoWriter | None = None

    def write(self, picture: NDArray[np.uint8]) -> None:
        """Append an image (H, W, 3) uint8 RGB."""
        if self._film is None:
            code = cv2.VideoWriter.fourcc(*"mp4v")
            size = (picture.shape[1], picture.shape[0])
            with utf8_path(self._path) as path:
                self._film = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, self._fps, size)
            if not self._film.isOpened():
                raise UserError(f"{self._path} cannot be written as a film; check folder and disk")
        self._film.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._film is None:
            return
        self._film.release()
        # OpenCV reports no full disk. The film's index is written last, so a cut film has none.
        if kind is None and self._path.is_file() and not _is_complete(self._path):
            raise UserError(
                f"{self._path} could not be written to its end; free some space and run the same "
                "command again"
            )


def _is_complete(path: Path) -> bool:
    with path.open("rb") as file:
        found = list(boxes(file, 0, path.stat().st_size))
    return any(kind == b"moov" for kind, _, _ in found) and found[-1][2] <= path.stat().st_size


def boxes(file: BinaryIO, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield (type, first byte of the content, end) of each box of an MP4 file between the bytes
    `start` and `end`. Positions are in bytes from the begin of the file.

    The last box can end beyond `end`. The iteration stops at bytes that are no box. Source: ISO
    14496-12.
    """
    while start + BOX_HEAD <= end:
        file.seek(start)
        head = file.read(2 * BOX_HEAD)
        size, kind, content = int.from_bytes(head[:4], "big"), head[4:8], start + BOX_HEAD
        if size == 1:
            size, content = int.from_bytes(head[8:16], "big"), start + 2 * BOX_HEAD
        elif size == 0:  # to the end of the file
            size = end - start
        if start + size < content or not kind.isascii() or not kind.decode("ascii").isprintable():
            return
        start += size
        yield kind, content, start
