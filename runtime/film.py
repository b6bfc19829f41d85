"""Films: pictures written one after the other as MPEG-4 (.mp4)."""

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.files import utf8_path
from trackfeatures.errors import UserError

FILM_SUFFIX = ".mp4"
BOX_HEAD = 8


class Film:
    """A film at `fps` pictures a second, playable also when its command is interrupted.

    The first picture gives the size. A context manager that closes the file. Raises UserError when
    the file cannot be written, at the latest when it is closed.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self._path, self._fps = path, fps
        self._film: cv2.VideoWriter | None = None

    def write(self, picture: NDArray[np.uint8]) -> None:
        """Add a picture (H, W, 3) RGB."""
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
        # The writer is silent about a full disk; the index of the film is written last.
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
    """(type, start, end of the content) of each box of an MP4 file from byte `start` to `end`.

    The last one may end beyond `end`; bytes that are no box end the list. Source: ISO 14496-12.
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
