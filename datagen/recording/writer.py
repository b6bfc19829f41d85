"""Writing one round as an MCAP file; the same frames give the same bytes on any machine."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from . import messages, topics
from .encoding import encode
from .frame import Frame
from .header import RESULT_METADATA, RoundHeader, RoundResult
from .round_file import RoundFile


class RoundWriter:
    """Frames in, one at a time; `finish` closes the file. A context manager: an error closes it.

    `scene` are named polylines of the track in the world, (N, 3) m each.
    """

    def __init__(
        self, path: Path, header: RoundHeader, scene: Mapping[str, NDArray[np.float64]]
    ) -> None:
        self.path = path
        self.header = header
        self.frames = 0
        self._content = hashlib.sha256()
        self._file = RoundFile(path, header)
        start = topics.log_time_ns(0, header.frequency_hz)
        track = messages.track_scene(scene, messages.timestamp(start))
        self._add(topics.TRACK_SCENE, start, track)

    def add(self, frame: Frame) -> None:
        """Append one control step to every topic."""
        header = self.header
        time = topics.log_time_ns(self.frames, header.frequency_hz)
        stamp = messages.timestamp(time)
        image = encode(frame.image, header.codec)
        labels = messages.labels(frame)
        self._content.update(image)
        self._content.update(labels)
        if self.frames % header.frequency_hz == 0:
            self._add(topics.CALIBRATION, time, messages.calibration(header.camera, stamp))
        self._add(topics.CAMERA, time, messages.compressed_image(image, header.codec, stamp))
        self._add(topics.ANNOTATIONS, time, messages.annotations(frame, stamp))
        self._add(topics.LABELS, time, labels)
        self._add(topics.EGO_STATE, time, messages.ego_state(frame.ego))
        self._add(topics.SENSORS, time, messages.sensors(frame.sensors))
        self._add(topics.COMMAND, time, messages.command(frame.command))
        self._add(topics.TRAFFIC, time, messages.traffic(frame, stamp))
        self._add(topics.TRANSFORMS, time, messages.transforms(frame.ego, header.camera, stamp))
        self.frames += 1

    def finish(
        self,
        laps: int = 0,
        resets: int = 0,
        distance_m: float = 0.0,
        mean_speed_kmh: float = 0.0,
    ) -> RoundResult:
        """Write the result and the index, and close the file."""
        result = RoundResult(
            frames=self.frames,
            content_hash=self._content.hexdigest(),
            laps=laps,
            resets=resets,
            distance_m=distance_m,
            mean_speed_kmh=mean_speed_kmh,
        )
        self._file.add_metadata(RESULT_METADATA, result.to_metadata())
        self._file.finish()
        return result

    def __enter__(self) -> "RoundWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.__exit__(kind, error, trace)

    def _add(self, topic: str, time: int, data: bytes) -> None:
        self._file.add(topic, time, self.frames, data)
