"""What a round says about itself: metadata `driverview.round` before it, `driverview.result` after.

MCAP metadata maps strings to strings, so every value is written as JSON.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import trackfeatures as tf

from .camera import CameraInfo

ROUND_METADATA = "driverview.round"
RESULT_METADATA = "driverview.result"


@dataclass(frozen=True, slots=True)
class RoundHeader:
    """All that is known of a round before its first frame."""

    id: str
    seed: int
    track: str
    track_hash: str
    lanes: int
    lane_width_m: float
    traffic: int
    trajectory: str
    light: str
    speed_kmh: float
    frequency_hz: int = 20
    codec: str = "jpeg"
    plan_hash: str = ""
    definitions: str = tf.VERSION
    program: str = ""
    camera: CameraInfo = field(default_factory=CameraInfo)

    def to_metadata(self) -> dict[str, str]:
        return {name: json.dumps(value) for name, value in asdict(self).items()}

    @staticmethod
    def from_metadata(metadata: Mapping[str, str]) -> "RoundHeader":
        """Raises KeyError, TypeError or ValueError where the metadata is not of our kind."""
        values: dict[str, Any] = {name: json.loads(text) for name, text in metadata.items()}
        values["camera"] = CameraInfo(**values["camera"])
        values["definitions"] = str(values["definitions"])
        return RoundHeader(**values)


@dataclass(frozen=True, slots=True)
class RoundResult:
    """What became of a round: `content_hash` covers its images and labels, not its name."""

    frames: int
    content_hash: str
    laps: int = 0
    resets: int = 0
    distance_m: float = 0.0
    mean_speed_kmh: float = 0.0

    def to_metadata(self) -> dict[str, str]:
        return {name: json.dumps(value) for name, value in asdict(self).items()}

    @staticmethod
    def from_metadata(metadata: Mapping[str, str]) -> "RoundResult":
        return RoundResult(**{name: json.loads(text) for name, text in metadata.items()})


@dataclass(frozen=True, slots=True)
class RoundInfo:
    """A recorded round as the reader shows it; `split` is train or test."""

    id: str
    seed: int
    track: str
    lanes: int
    split: str
    light: str
    traffic: int
    trajectory: str
    frames: int
    speed_kmh: float
    lane_width_m: float
    content_hash: str
    path: Path

    @staticmethod
    def of(path: Path, header: RoundHeader, result: RoundResult, split: str) -> "RoundInfo":
        return RoundInfo(
            id=header.id,
            seed=header.seed,
            track=header.track,
            lanes=header.lanes,
            split=split,
            light=header.light,
            traffic=header.traffic,
            trajectory=header.trajectory,
            frames=result.frames,
            speed_kmh=header.speed_kmh,
            lane_width_m=header.lane_width_m,
            content_hash=result.content_hash,
            path=path,
        )
