"""What a round says about itself: metadata `driverview.round` before it, `driverview.result` after.

MCAP metadata maps strings to strings, so every value is written as JSON.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import trackfeatures as tf
from trackfeatures.camera import CameraParameters

ROUND_METADATA = "driverview.round"
RESULT_METADATA = "driverview.result"
RECOVERY_METADATA = "driverview.recovered"
MOST_PIXELS = 65_500  # of a side: what JPEG holds


def the_light(lights: tuple[str, ...]) -> str:
    """One light by its name, several as "changing"."""
    return lights[0] if len(set(lights)) == 1 else "changing"


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
    lights: tuple[str, ...]
    """Of each scene of the round: its stretches show them in turn, and again."""
    speed_kmh: float
    stretch: int = 0
    """Frames; 0: the round is one stretch."""
    frequency_hz: int = 20
    codec: str = "jpeg"
    plan_hash: str = ""
    definitions: str = tf.VERSION
    program: str = ""
    camera: CameraParameters = field(default_factory=CameraParameters)
    """What the images were taken with; varies from round to round where it was jittered..."""
    nominal_camera: CameraParameters | None = None
    """...about this one, the dataset's; absent where it was not."""

    @property
    def dataset_camera(self) -> CameraParameters:
        return self.nominal_camera or self.camera

    def require_sane(self) -> None:
        """Raise ValueError where a value cannot be: damage reaches no computation."""
        camera = self.camera
        if type(self.frequency_hz) is not int or self.frequency_hz < 1:
            raise ValueError(f"its header tells of {self.frequency_hz!r} frames a second")
        if type(self.stretch) is not int or self.stretch < 0 or not self.lights:
            raise ValueError(f"its header tells of {self.lights!r} by {self.stretch!r} frames")
        for size in (camera.width, camera.height):
            if type(size) is not int or not 0 < size <= MOST_PIXELS:
                raise ValueError(f"its header tells of an image of {camera.width}x{camera.height}")

    def to_metadata(self) -> dict[str, str]:
        return {name: json.dumps(value) for name, value in asdict(self).items()}

    @staticmethod
    def from_metadata(metadata: Mapping[str, str]) -> "RoundHeader":
        """Raises KeyError, TypeError or ValueError where the metadata is not of our kind."""
        values: dict[str, Any] = {name: json.loads(text) for name, text in metadata.items()}
        for name in ("camera", "nominal_camera"):
            if values[name] is not None:
                values[name] = CameraParameters(**values[name])
        values["lights"] = tuple(values["lights"])
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
class Recovery:
    """What `datagen recover` notes in a round: not what was recorded, but what was whole of it.

    `lost` frames are missing; when the file did not say how many it had, `at_least` so many.
    """

    source: str
    saved: int
    lost: int
    at_least: bool

    def to_metadata(self) -> dict[str, str]:
        return {name: json.dumps(value) for name, value in asdict(self).items()}

    @staticmethod
    def from_metadata(metadata: Mapping[str, str]) -> "Recovery":
        return Recovery(**{name: json.loads(text) for name, text in metadata.items()})

    def __str__(self) -> str:
        least = "at least " if self.at_least else ""
        return f"{self.saved} frames saved from {self.source}, {least}{self.lost} lost"


@dataclass(frozen=True, slots=True)
class RoundInfo:
    """A recorded round as the reader shows it; `split` is train or test."""

    id: str
    seed: int
    track: str
    lanes: int
    split: str
    lights: tuple[str, ...]
    traffic: int
    trajectory: str
    frames: int
    speed_kmh: float
    lane_width_m: float
    content_hash: str
    path: Path

    @property
    def light(self) -> str:
        """The round's light in a word."""
        return the_light(self.lights)

    def kinds(self, name: str) -> tuple[str, ...]:
        """What the round has of `name`: one track, but perhaps several lights."""
        return self.lights if name == "light" else (str(getattr(self, name)),)

    @staticmethod
    def of(path: Path, header: RoundHeader, result: RoundResult, split: str) -> "RoundInfo":
        return RoundInfo(
            id=header.id,
            seed=header.seed,
            track=header.track,
            lanes=header.lanes,
            split=split,
            lights=header.lights,
            traffic=header.traffic,
            trajectory=header.trajectory,
            frames=result.frames,
            speed_kmh=header.speed_kmh,
            lane_width_m=header.lane_width_m,
            content_hash=result.content_hash,
            path=path,
        )
