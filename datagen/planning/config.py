"""The options of a collection, with the default of each."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import trackfeatures as tf
from datagen.recording.names import CODECS, UNSEEN
from trackfeatures.camera import CameraParameters, stored
from trackfeatures.errors import UserError
from trackfeatures.names import require_name

DATASET_FOLDER = Path("datasets/default")
UNSEEN_FOLDER = Path("datasets/unseen")

FRAMES_PER_SCENE = 200
"""Default number of frames for each scene; building one takes as long as about 15 frames."""
SEEDS_PER_PLAN = 1_000_000
MAX_ROUNDS = SEEDS_PER_PLAN // 2
"""With more rounds, the seeds would overlap with those of another plan."""


def all_lights() -> tuple[str, ...]:
    """Names of all lighting conditions of the camera simulation."""
    from simulator.camera import KINDS  # here, because help texts are printed without the simulator

    return KINDS


@dataclass(frozen=True, slots=True)
class TrackChoice:
    """Name of a track and the hash of its geometry when the plan was made; or `random` without a
    hash: a random road for each round."""

    name: str
    content_hash: str


@dataclass(frozen=True)
class CollectConfig:
    """Options of a collection. Raises UserError for values that cannot be collected."""

    rounds: int = 60
    frames: int = 2000
    """Per round."""
    seed: int = 0
    tracks: tuple[TrackChoice, ...] = field(kw_only=True)
    lanes: tuple[int, ...] = (1, 2, 3)
    lights: tuple[str, ...] = field(default_factory=all_lights)
    test_share: float = 0.25
    """Share of the rounds held out for testing, 0 to below 1."""
    codec: str = "jpeg"
    frequency_hz: int = 20
    """Frames per second. The car is controlled at `plan.CONTROL_HZ` or faster."""
    camera: CameraParameters = field(default_factory=CameraParameters)
    stretch: int = 0
    """Frames after which scenery and light change; 0: a round is a film in one scenery."""
    scenes: int = 0
    """Number of sceneries that the stretches of a round cycle through; 0: one for every
    `FRAMES_PER_SCENE`."""
    jitter_camera: bool = False
    """Vary height, pitch and field of view of the camera a little from round to round."""
    roads: str = "paper"
    """"paper": lanes of 4.0 m and the paint of the tracks; "varied": drawn for each round."""
    prefix: str = "round"
    """First part of the rounds' names; collections with different prefixes can be merged."""
    split: str = ""
    """"unseen": all rounds test on tracks without training data; "": train and test."""

    def as_dict(self) -> dict[str, Any]:
        """The options by name; options in `LATER` only if they differ from their defaults."""
        options = asdict(self, dict_factory=stored)
        return {k: v for k, v in options.items() if k not in LATER or v != LATER[k]}

    def __post_init__(self) -> None:
        self._check_numbers()
        self._check_choices()

    def _check_numbers(self) -> None:
        from simulator.world.control_rate import check_frequency

        if not 1 <= self.rounds <= MAX_ROUNDS or self.frames < 1:
            raise UserError(
                f"{self.rounds} rounds of {self.frames} frames asked for; give 1 to {MAX_ROUNDS} "
                "rounds of at least 1 frame"
            )
        if self.stretch < 0:
            raise UserError(
                f"a stretch of {self.stretch} frames asked for; give the number of frames until "
                "the scenery changes, or 0 for one scenery a round"
            )
        if self.scenes < 0:
            raise UserError(
                f"{self.scenes} scenes a round asked for; give at least 1, or 0 for one for every "
                f"{FRAMES_PER_SCENE} frames"
            )
        if self.scenes > 1 and not self.stretch:
            raise UserError(
                f"{self.scenes} scenes a round asked for, but the scenery never changes; give "
                "--stretch too, the number of frames until it does"
            )
        if self.seed < 0:
            raise UserError(f"the seed is {self.seed}; give a whole number from 0 up")
        if self.jitter_camera and self.camera.matrix is not None:
            raise UserError(
                "--jitter-camera varies the field of view, which the camera file's matrix fixes; "
                "leave one out"
            )
        if not 0.0 <= self.test_share < 1.0:
            raise UserError(f"the test share is {self.test_share}; give 0 to below 1, e.g. 0.25")
        check_frequency(self.frequency_hz)

    def _check_choices(self) -> None:
        from simulator.varied import ROADS

        for lanes in self.lanes:
            tf.check_lanes(lanes, tf.LANE_WIDTH_M)
        if not (self.lanes and self.tracks and self.lights):
            raise UserError("tracks, lanes or lights are empty; give at least one of each")
        for name, given, known in (
            ("light", self.lights, all_lights()),
            ("codec", (self.codec,), CODECS),
            ("roads", (self.roads,), ROADS),
        ):
            if unknown := set(given) - set(known):
                raise UserError(f"unknown {name} {min(unknown)!r}; choose {', '.join(known)}")
        require_name(self.prefix, "prefix of the rounds' names")
        if self.split not in ("", UNSEEN):
            raise UserError(f"there is no split {self.split!r} to collect; give {UNSEEN} or none")


LATER = {"roads": CollectConfig.roads, "prefix": CollectConfig.prefix}
"""Options that plans of earlier versions do not have, with their defaults."""


@dataclass(frozen=True)
class ProtocolConfig:
    """Options of `datagen protocol`. Raises UserError for drives of no length."""

    rounds: int = 15
    """On the nine tracks, as many as the paper's."""
    frames: int = 2000
    """Of each of these rounds: the paper's 30,000 test images in all."""
    laps: float = 1.0
    """Of each drive."""
    seed: int = 1810

    def __post_init__(self) -> None:
        if self.laps <= 0:
            raise UserError(f"{self.laps:g} laps asked for; give more than 0, such as 1")
