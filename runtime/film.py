"""Films: pictures written one after the other as MPEG-4 (.mp4)."""

from pathlib import Path
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from trackfeatures.errors import UserError

FILM_SUFFIX = ".mp4"


class Film:
    """A film at `fps` pictures a second, playable also when its command is interrupted.

    The first picture gives the size. A context manager that closes the file. Raises UserError when
    the file cannot be written.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self._path, self._fps = path, fps
        self._film: cv2.VideoWriter | None = None

    def write(self, picture: NDArray[np.uint8]) -> None:
        """Add a picture (H, W, 3) RGB."""
        if self._film is None:
            code = cv2.VideoWriter.fourcc(*"mp4v")
            size = (picture.shape[1], picture.shape[0])
            self._film = cv2.VideoWriter(str(self._path), code, self._fps, size)
            if not self._film.isOpened():
                raise UserError(f"{self._path} cannot be written as a film; check folder and disk")
        self._film.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._film is not None:
            self._film.release()
