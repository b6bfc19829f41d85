"""Reads live pictures of a webcam, by its number or device, or of a stream, by its address (RTSP,
HTTP, ...).

FFmpeg's documentation of protocols describes the addresses and their options. Every wait has a time
limit: a stream that stalls ends with a fault, and the answers so far are kept.
"""

import os
import re
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mtlnet.sources.ffmpeg_log import DecodingErrors, decoding_errors
from mtlnet.sources.films import silent_opencv
from mtlnet.sources.pictures import Picture, other_size
from trackfeatures.errors import UserError

SCHEMES = ("rtsp", "rtsps", "http", "https", "rtmp", "rtmps", "srt", "udp", "tcp", "rtp")
WEBCAM = re.compile(r"(?:/dev/video)?(\d{1,4})|/dev/video")
ADDRESS = re.compile(r"([a-z][a-z0-9+.-]*)://", re.IGNORECASE)
OPEN_S, STALL_S = 10.0, 10.0
"""Time limits, s, for the first picture and for each later picture. The longest usual interval
between key frames is about 10 s."""
AT_ONCE_S = 0.05  # a read that takes longer has waited for its picture
DEVICES = Path("/dev")


def is_live(given: str) -> bool:
    """Return whether an input names a webcam or the address of a stream, and no existing file or
    folder."""
    if os.path.isfile(given) or os.path.isdir(given):  # noqa: PTH112, PTH113  # Path raises for long names
        return False
    return given.isdecimal() or given.startswith("/dev/video") or bool(ADDRESS.match(given))


def shown_name(given: str) -> str:
    """Return the name of an input for tables, films and messages: "webcam 0" for the number 0, and
    an address without its user and password."""
    if given.isdecimal():
        return f"webcam {given}"
    if not ADDRESS.match(given):
        return given
    scheme, _, rest = given.partition("://")
    host = re.split("[/?#]", rest, maxsplit=1)[0]
    _, colon, port = host.rpartition(":")
    if "@" in host:
        rest = rest[host.rindex("@") + 1 :]
    elif colon and not port.isdecimal():  # a password with / ? or #, not written as %2F %3F %23
        rest = rest.rpartition("@")[2]
    return f"{scheme}://{rest}"


@dataclass
class Stream:
    """An opened webcam or stream. After the last picture, `fault` describes an early end or damaged
    pictures; if it is empty, `note` describes the normal end."""

    name: str
    film: cv2.VideoCapture
    errors: DecodingErrors
    opened: ExitStack
    fault: str = ""
    note: str = ""
    fps: float = 0.0
    damaged: int = 0
    """Number of pictures in which FFmpeg reported an error."""
    first_error: str = ""

    def pictures(self) -> Iterator[Picture]:
        """Yields the pictures as they arrive, each with its time of arrival, s since 1970."""
        self.errors.forget()
        with self.opened, silent_opencv():
            number, waited_s = 0, 0.0
            while True:
                begin = time.monotonic()
                with self.errors.reading():
                    found, frame = self.film.read()
                took_s = time.monotonic() - begin
                # After a stall the decoder returns at once the pictures that it has kept.
                waited_s = took_s if took_s > AT_ONCE_S else max(waited_s, took_s)
                if not found:
                    self._end(number, waited_s)
                    return
                image = frame.astype(np.uint8, copy=False)
                if size := self.errors.new_size(image.shape):
                    first = (image.shape[1], image.shape[0])
                    self.fault = other_size(self.name, number, size, first)
                    return
                self._note_damage(number)
                yield Picture(number, image, time.time(), bgr=True)
                number += 1

    def damage(self) -> str:
        """Return a text about the damaged pictures."""
        return f"{self.damaged} of its pictures came damaged and may be wrong ({self.first_error})"

    def _note_damage(self, number: int) -> None:
        """Count a picture in which FFmpeg reported an error. Picture 0 is not counted, because a
        stream joined between key frames starts with errors."""
        if self.errors.count and number:
            self.damaged += 1
            self.first_error = self.first_error or self.errors.first
        self.errors.forget()

    def _end(self, number: int, waited_s: float) -> None:
        told = f" ({self.errors.first})" if self.errors.first else ""
        if waited_s > 0.9 * STALL_S:
            self.fault = (
                f"{self.name} sent nothing for {waited_s:.0f} s after {number} pictures{told}; "
                "these pictures were used: check camera and network"
            )
        elif told or not number:
            self.fault = (
                f"{self.name} broke off after {number} pictures{told}; these pictures were used: "
                "check camera and network"
            )
        elif self.damaged:
            self.fault = f"{self.name} ended after {number} pictures; {self.damage()}"
        else:
            self.note = f"{self.name} ended after {number} pictures"


def open_stream(given: str) -> Stream:
    """Open the webcam or stream named `given`. Raises UserError when it cannot be opened; a stream
    must open within 10 s."""
    name = shown_name(given)
    scheme = ADDRESS.match(given)
    if scheme and scheme[1].lower() not in SCHEMES:
        raise UserError(
            f"{name}: streams of kind {scheme[1]} are not read; give one of "
            f"{', '.join(SCHEMES)}, or a file by its path"
        )
    webcam = WEBCAM.fullmatch(given)
    if not scheme and webcam is None:
        raise UserError(f"{name} is no webcam; give its number, 0 to 9999, or /dev/videoNUMBER")
    opened = ExitStack()
    errors = opened.enter_context(decoding_errors())
    limits = [
        cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, int(1e3 * OPEN_S),
        cv2.CAP_PROP_READ_TIMEOUT_MSEC, int(1e3 * STALL_S),
    ]  # fmt: skip
    with silent_opencv(), errors.opening():
        if webcam is None:
            film = cv2.VideoCapture(given, cv2.CAP_FFMPEG, limits)
        else:
            film = cv2.VideoCapture(int(webcam[1] or 0), cv2.CAP_V4L2)
    opened.callback(film.release)
    if film.isOpened():
        fps = film.get(cv2.CAP_PROP_FPS)
        return Stream(name, film, errors, opened, fps=fps if 0 < fps < 1000 else 0.0)
    told = f" ({errors.first})" if errors.first else ""
    opened.close()
    if scheme:
        raise UserError(
            f"{name} cannot be opened as a stream within {OPEN_S:g} s{told}; check the address "
            "with another player"
        )
    found = ", ".join(sorted(path.name for path in DEVICES.glob("video*"))) or "none"
    raise UserError(f"{name} cannot be opened; the cameras of this machine are: {found}")
