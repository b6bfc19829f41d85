"""Reads the frames of a film with OpenCV's FFmpeg, in the form in which a player shows them.

The frames are rotated by quarter turns and scaled to square pixels if the header requires it;
FFmpeg itself applies the range and matrix of the colours and omits frames before the start (edit
lists). The number of frames in a header is an estimate: a film ends where FFmpeg finds no more. A
film has a fault if it breaks off or FFmpeg reports an error.
"""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mtlnet.sources.ffmpeg_log import DecodingErrors, decoding_errors
from mtlnet.sources.film_header import missing_end, stated_frames, unsupported_picture
from mtlnet.sources.pictures import Image, Picture, other_size
from trackfeatures.errors import UserError

MAX_LOST = 100
"""Number of consecutive undecodable frames after which the film is considered to have ended."""
MAX_STRETCH = 10.0
CODECS = {"AV01": "AV1", "av01": "AV1", "h264": "H.264", "avc1": "H.264", "hevc": "H.265"}
CONVERT = "convert it, e.g. with `ffmpeg -i FILM -c:v libx264 new.mp4`"


@dataclass(frozen=True)
class FilmHeader:
    """Header of a film. `count`: estimated number of frames, 0 if unknown; `fps`: frames per
    second, 0 if not stated."""

    count: int
    fps: float


def read_film_header(path: Path) -> FilmHeader:
    """Read the header of the film at `path`. Raises UserError for a file that is not a film,
    OSError for an unreadable file."""
    with decoding_errors() as errors:
        film = _open(path, errors)
        count, fps = film.get(cv2.CAP_PROP_FRAME_COUNT), film.get(cv2.CAP_PROP_FPS)
        film.release()
    return FilmHeader(int(count) if 0 < count < 1e9 else 0, fps if 0 < fps < 1000 else 0.0)


@dataclass
class Film:
    """A film whose frames can be read. `fault`, set after the last frame, describes the film's
    fault; empty if it has none."""

    path: Path
    fault: str = ""

    def pictures(self) -> Iterator[Picture]:
        """Yields the frames of the film, numbered from 0.

        A frame that cannot be decoded is skipped, but counted. Raises UserError for a file that is
        not a film, OSError for an unreadable file.
        """
        with decoding_errors() as errors:
            film = _open(self.path, errors)
            try:
                yield from self._frames(film, errors)
            finally:
                film.release()

    def _frames(self, film: cv2.VideoCapture, errors: DecodingErrors) -> Iterator[Picture]:
        stretch = _stretch(self.path, film)
        errors.forget()  # errors while FFmpeg probes the format do not count
        number = used = lost = 0
        damaged_at = -1
        while lost < MAX_LOST:
            with errors.reading():
                found, frame = film.read()
            if errors.count and damaged_at < 0:
                damaged_at = number
            if not found:
                lost += 1
                continue
            if errors.unconverted:
                raise UserError(f"{self.path}: frame {number}: {_unconverted(errors)}")
            number += lost
            lost = 0
            if size := errors.new_size(frame.shape):
                first = (frame.shape[1], frame.shape[0])
                self.fault = other_size(str(self.path), number, size, first)
                return
            image = frame.astype(np.uint8, copy=False)
            if stretch != (1.0, 1.0):
                image = _stretched(image, stretch)
            yield Picture(number, image, film.get(cv2.CAP_PROP_POS_MSEC) / 1e3, bgr=True)
            number, used = number + 1, used + 1
        self.fault = self._find_fault(film, errors, used, number - used, damaged_at)

    def _find_fault(
        self, film: cv2.VideoCapture, errors: DecodingErrors, used: int, lost: int, damaged_at: int
    ) -> str:
        if not used:
            return f"{self.path}: {no_frame(film, errors)}"
        reason = missing_end(self.path)
        if reason:
            stated = int(film.get(cv2.CAP_PROP_FRAME_COUNT))
            share = f"{used} of {stated}" if stated > used else f"{used}"
            return (
                f"{self.path} ends after {share} frames; these frames were used "
                f"(it breaks off: {reason})"
            )
        lost = max(lost, stated_frames(self.path, int(film.get(cv2.CAP_PROP_FRAME_COUNT))) - used)
        if damaged_at < 0 and not lost:
            return ""
        told = f" ({errors.first})" if errors.first else ""
        near = f" near frame {damaged_at}" if damaged_at >= 0 else ""
        missing = f"{lost} could not be" if lost else "frames after it may be wrong"
        return f"{self.path} is damaged{near}{told}: {used} frames were used, {missing}"


def _open(path: Path, errors: DecodingErrors) -> cv2.VideoCapture:
    """The opened film at `path`. Raises UserError when it cannot be opened or shown as stored.

    OpenCV gets the path of an open file descriptor: it would end the process at a name that is not
    UTF-8, and FFmpeg takes a name with a colon for a protocol.
    """
    with _opened(path) as name, silent_opencv(), errors.opening():
        film = cv2.VideoCapture(name, cv2.CAP_FFMPEG)
    if not film.isOpened():
        told = f" ({errors.first})" if errors.first else ""
        raise UserError(
            f"{path} cannot be opened as a film{told}; check it with another player, or {CONVERT}"
        )
    reason = unsupported_picture(path)
    if turned := int(film.get(cv2.CAP_PROP_ORIENTATION_META)) % 90:
        reason = f"its header turns the picture by {turned} degrees more than quarter turns"
    if reason:
        film.release()
        raise UserError(f"{path}: {reason}; {CONVERT}, which makes pictures as they are shown")
    return film


@contextmanager
def silent_opencv() -> Iterator[None]:
    """Silence OpenCV's warning on stderr about a film that it cannot open, because the raised error
    has more details."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


@contextmanager
def _opened(path: Path) -> Iterator[str]:
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise UserError(f"{path} is a folder, a pipe or a device; save it as a file")
        yield f"/dev/fd/{descriptor}"
    finally:
        os.close(descriptor)


def _stretch(path: Path, film: cv2.VideoCapture) -> tuple[float, float]:
    """Factors of width and height that make the pixels square."""
    wide, high = film.get(cv2.CAP_PROP_SAR_NUM), film.get(cv2.CAP_PROP_SAR_DEN)
    if wide <= 0 or high <= 0 or wide == high:
        return 1.0, 1.0
    ratio = wide / high
    if not 1 / MAX_STRETCH <= ratio <= MAX_STRETCH:
        raise UserError(f"{path}: its pixels are {ratio:g} times as wide as high; {CONVERT}")
    if int(film.get(cv2.CAP_PROP_ORIENTATION_META)) % 180:  # the picture has been rotated already
        ratio = 1 / ratio
    return (ratio, 1.0) if ratio > 1 else (1.0, 1 / ratio)


def _stretched(picture: Image, stretch: tuple[float, float]) -> Image:
    height, width = picture.shape[:2]
    size = (round(width * stretch[0]), round(height * stretch[1]))
    return cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR).astype(np.uint8, copy=False)


def _unconverted(errors: DecodingErrors) -> str:
    if "interlaced" in errors.unconverted:
        return (
            "its pictures are interlaced, which this build of OpenCV does not convert; make whole "
            "ones, e.g. with `ffmpeg -i FILM -vf yadif -c:v libx264 new.mp4`"
        )
    return f"its colours cannot be converted ({errors.unconverted}); {CONVERT}"


def no_frame(film: cv2.VideoCapture, errors: DecodingErrors) -> str:
    """Return a text about why no frame can be read of a film that could be opened."""
    packed = int(film.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF
    code = packed.to_bytes(4, "little").decode("latin-1").strip("\0 ")
    codec = CODECS.get(code, code if code.isprintable() else "") or "its codec"
    if "hardware" in errors.first or "not implemented" in errors.first.lower():
        return f"this build of OpenCV has no decoder for {codec}; {CONVERT}"
    told = f" ({errors.first})" if errors.first else ""
    return f"no frame of it ({codec}) can be decoded{told}; check it with another player"
