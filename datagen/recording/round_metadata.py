"""Metadata records of a round file: header, result and, in a recovered file, the recovery.

MCAP metadata maps strings to strings, so every value is written as JSON. The field names are part
of the file format.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import trackfeatures as tf
from trackfeatures.camera import CameraParameters, stored
from trackfeatures.measurement import LineOffsets
from trackfeatures.names import require_name

ROUND_METADATA = "driverview.round"
RESULT_METADATA = "driverview.result"
RECOVERY_METADATA = "driverview.recovered"
MAX_IMAGE_SIDE_PX = 65_500  # limit of JPEG
MAX_IMAGE_PX = 100_000_000


def summarize_lights(lights: tuple[str, ...]) -> str:
    """Return the name of the light if all `lights` are equal, otherwise "changing"."""
    return lights[0] if len(set(lights)) == 1 else "changing"


@dataclass(frozen=True, slots=True)
class RoundHeader:
    """The record `driverview.round`: the parameters of a round, known before its first frame."""

    id: str
    seed: int
    track: str
    track_hash: str
    lanes: int
    lane_width_m: float
    traffic: int
    trajectory: str
    lights: tuple[str, ...]
    """Names of the lights. Each stretch of `stretch` frames has the next light; after the last
    light the first one follows again."""
    speed_kmh: float
    stretch: int = 0
    """Number of frames in a row with the same scenery and light; 0: the whole round."""
    frequency_hz: int = 20
    codec: str = "jpeg"
    plan_hash: str = ""
    definitions: str = tf.VERSION
    program: str = ""
    camera: CameraParameters = field(default_factory=CameraParameters)
    """The camera of this round's images; with camera jitter it differs from round to round."""
    nominal_camera: CameraParameters | None = None
    """The camera of the dataset, if `camera` differs from it: by jitter, or by the height of a
    varied road."""
    varied: dict[str, Any] | None = None
    """The random values of a round of `--roads varied`; None on the paper's roads."""

    @property
    def dataset_camera(self) -> CameraParameters:
        return self.nominal_camera or self.camera

    @property
    def label_camera(self) -> CameraParameters:
        """The camera that training assumes for the round's images.

        On a varied road, this is `camera`, because every round has its own camera height; training
        scales the labels from this height to the height of the dataset's camera. On the paper's
        roads, this is the dataset's camera; training ignores camera jitter.
        """
        return self.camera if self.varied is not None else self.dataset_camera

    @property
    def line_offsets(self) -> LineOffsets:
        """For each marking, the offsets (m, left positive) of its leftmost and rightmost line from
        its nominal position; () on the paper's roads."""
        if self.varied is None:
            return ()
        lines = [each["lines"] for each in self.varied["carriageway"]["markings"]]
        ends = [(each[0], each[-1]) if each else ({"offset_m": 0.0},) * 2 for each in lines]
        return tuple((float(left["offset_m"]), float(right["offset_m"])) for left, right in ends)

    def validate(self) -> None:
        """Raise ValueError for an impossible value, before other code uses it."""
        require_name(self.id, "round id")
        camera = self.camera
        if type(self.frequency_hz) is not int or self.frequency_hz < 1:
            raise ValueError(
                f"its header has {self.frequency_hz!r} frames a second, expected 1 or more"
            )
        if type(self.stretch) is not int or self.stretch < 0 or not self.lights:
            raise ValueError(
                f"its header has stretches of {self.stretch!r} frames with lights {self.lights!r}"
            )
        for size in (camera.width, camera.height):
            if type(size) is not int or not 0 < size <= MAX_IMAGE_SIDE_PX:
                raise ValueError(f"its header has an image size of {camera.width}x{camera.height}")
        if camera.width * camera.height > MAX_IMAGE_PX:
            raise ValueError(
                f"its header has an image size of {camera.width}x{camera.height}; at most "
                f"{MAX_IMAGE_PX / 1e6:g} million px are read"
            )

    def to_metadata(self) -> dict[str, str]:
        values = asdict(self, dict_factory=stored)
        if self.varied is None:  # rounds on the paper's roads have the bytes of earlier versions
            del values["varied"]
        return {name: json.dumps(value) for name, value in values.items()}

    @staticmethod
    def from_metadata(metadata: Mapping[str, str]) -> "RoundHeader":
        """Read the record. Raises KeyError, TypeError or ValueError for metadata of another kind or
        version."""
        values: dict[str, Any] = {name: json.loads(text) for name, text in metadata.items()}
        for name in ("camera", "nominal_camera"):
            if values[name] is not None:
                values[name] = CameraParameters(**values[name])
        values["lights"] = tuple(values["lights"])
        values["definitions"] = str(values["definitions"])
        return RoundHeader(**values)


@dataclass(frozen=True, slots=True)
class RoundResult:
    """The record `driverview.result`: totals of a finished round. `content_hash` is the SHA-256 of
    the images and labels of the round."""

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
    """The record `driverview.recovered`: the round has only the undamaged frames of the file
    `source`.

    `saved` frames are in the round and `lost` frames are missing. If `at_least` is true, more
    frames can be missing, because the original number of frames is unknown.
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
    """A recorded round of an opened dataset. `split` is its side of the split, "" for none."""

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
    label_camera: CameraParameters = field(default_factory=CameraParameters)
    """The camera that training assumes for the round's images."""
    line_offsets: LineOffsets = ()
    """Offsets (m) of the lines of each marking on a varied road; () on the paper's roads."""

    @property
    def light(self) -> str:
        """The name of the round's light; "changing" if there are several."""
        return summarize_lights(self.lights)

    @property
    def track_group(self) -> str:
        """The name under which the round's frames are counted: the track, or `random` for every
        random road (such as `random:7`)."""
        return "random" if self.track.startswith("random:") else self.track

    def values_of(self, name: str) -> tuple[str, ...]:
        """Return the values of the attribute `name` in this round: the names of all its lights for
        "light", otherwise a single value."""
        if name == "light":
            return self.lights
        return (self.track_group if name == "track" else str(getattr(self, name)),)

    @staticmethod
    def of(path: Path, header: RoundHeader, result: RoundResult, split: str) -> "RoundInfo":
        names = [each.name for each in fields(RoundInfo)]
        parts = {name: getattr(header, name) for name in names if hasattr(header, name)}
        parts |= {"frames": result.frames, "content_hash": result.content_hash}
        return RoundInfo(**parts, path=path, split=split)
