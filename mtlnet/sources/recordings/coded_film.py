"""Decodes Foxglove's `CompressedVideo`, one picture per message, with OpenCV's FFmpeg.

The messages are written to a temporary IVF file, in which each message has its number as its time,
so that an undecodable picture does not change the numbers of later pictures. FFmpeg does not read
H.265 in IVF. H.265 messages are therefore written as a raw stream, whose decoded pictures are
counted. Source: the IVF header of libvpx.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from mtlnet.inference.image_decoding.errors import ImageError
from mtlnet.sources.ffmpeg_log import decoding_errors
from mtlnet.sources.films import no_frame, silent_opencv
from mtlnet.sources.pictures import Picture, other_size
from trackfeatures.errors import UserError

CODES = {"h264": b"H264", "h265": b"", "vp9": b"VP90", "av1": b"AV01"}
HEADER = struct.Struct("<4sHH4sHHIIII")
FRAME = struct.Struct("<IQ")
RATE = 1000
Packet = tuple[float, str, bytes]
"""Time in s, format ("h264", "h265", "vp9" or "av1") and data of a message."""


class CodedFilm:
    """Collects the messages of a topic, then decodes them. `fault`, set after the last picture,
    describes missing pictures; empty if none is missing."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.fault = ""
        self._times: list[float] = []
        self._written: list[int] = []  # numbers of the messages in the file
        self._unreadable = ""  # text about the first unreadable message
        self._in_ivf = True

    def pictures(self, packets: Iterator[Packet | ImageError]) -> Iterator[Picture]:
        """Yields the pictures of `packets`, one for each message of the topic. The packet of a
        message that cannot be read is its error; no picture is yielded for it.

        Raises UserError for an unsupported format, and if no picture can be decoded.
        """
        with TemporaryDirectory(prefix="driverview-") as folder:
            file = Path(folder) / "film"
            self._write(file, packets)
            yield from self._decoded(file)

    def _write(self, path: Path, packets: Iterator[Packet | ImageError]) -> None:
        with path.open("wb") as file:
            for number, packet in enumerate(packets):
                if isinstance(packet, ImageError):
                    self._unreadable = self._unreadable or str(packet)
                    self._times.append(0.0)
                    continue
                time_s, form, data = packet
                if form not in CODES:
                    raise UserError(
                        f"{self._name}: its format {form!r} is not read; known are "
                        f"{', '.join(CODES)}"
                    )
                self._in_ivf = bool(CODES[form])
                if self._in_ivf and not self._written:
                    file.write(HEADER.pack(b"DKIF", 0, 32, CODES[form], 16, 16, RATE, 1, 0, 0))
                if self._in_ivf:
                    file.write(FRAME.pack(len(data), number))
                file.write(data)
                self._times.append(time_s)
                self._written.append(number)
        if self._unreadable and not self._written:
            raise UserError(f"{self._name}: none of its messages can be read ({self._unreadable})")

    def _decoded(self, path: Path) -> Iterator[Picture]:
        used = 0
        with decoding_errors() as errors:
            with silent_opencv(), errors.opening():
                film = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
            try:
                errors.forget()
                while film.isOpened():
                    with errors.reading():
                        found, frame = film.read()
                    if not found:
                        break
                    counted = self._written[min(used, len(self._written) - 1)]
                    number = round(film.get(cv2.CAP_PROP_PTS)) if self._in_ivf else counted
                    number = min(max(number, counted), self._written[-1])
                    if size := errors.new_size(frame.shape):
                        first = (frame.shape[1], frame.shape[0])
                        self.fault = other_size(self._name, number, size, first)
                        return
                    image = frame.astype(np.uint8, copy=False)
                    yield Picture(number, image, self._times[number], bgr=True)
                    used += 1
                if not used:
                    raise UserError(f"{self._name}: {no_frame(film, errors)}")
            finally:
                film.release()
        if used < len(self._times):
            reason = self._unreadable or errors.first
            told = f" ({reason})" if reason else ""
            self.fault = (
                f"{self._name}: {len(self._times) - used} of {len(self._times)} pictures cannot be "
                f"decoded{told}; all other pictures were used"
            )
