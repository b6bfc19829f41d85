"""The options of `datagen collect` and `datagen protocol`, with their help texts and defaults.

`runtime.options.options_of` makes command-line options of the annotated fields.
"""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

from typer import Option

import trackfeatures as tf
from datagen.recording.names import CODECS, POSES, UNSEEN
from trackfeatures.camera import CameraParameters, stored
from trackfeatures.errors import UserError
from trackfeatures.names import require_name

DATASET_FOLDER = Path("datasets/default")
UNSEEN_FOLDER = Path("datasets/unseen")

FRAMES_PER_SCENE = 200
"""Default number of frames per scene (scenery with its light). Building a scene takes as long as
rendering about 15 frames."""
SEEDS_PER_PLAN = 1_000_000
MAX_ROUNDS = SEEDS_PER_PLAN // 2
"""Largest number of rounds of a plan; the seeds of more rounds would overlap with another plan."""
MAX_SEED = 10**12
"""Largest seed of a plan: the seeds of its rounds are below 2^63, the limit of random roads."""

MAX_LAPS = 1000
"""Largest number of laps of a drive, which is one file and is planned in memory."""


def all_lights() -> tuple[str, ...]:
    """Return the names of all lighting conditions of the camera simulation."""
    from simulator.camera import KINDS  # here, because help texts are printed without the simulator

    return KINDS


@dataclass(frozen=True, slots=True)
class TrackChoice:
    """A track and the hash of its geometry when the plan was made. The name `random` with an empty
    hash stands for a different random road in each round."""

    name: str
    content_hash: str
    picture_hash: str = ""
    """Hash of geometry, surface, scenery and paint (`Track.picture_hash`); "" for unknown."""


Rounds = Annotated[int, Option(help="Number of rounds (recorded drives).")]
Frames = Annotated[int, Option(help="Number of frames in each round.")]
Seed = Annotated[int, Option(help="Seed of all random choices, 0 to 10^12.")]
TestShare = Annotated[
    float,
    Option(
        "--split-test-share", help="Share of the rounds that are kept for testing, 0 to below 1."
    ),
]
Stretch = Annotated[
    int,
    Option(
        help="Number of frames after which scenery, light and weather change; 0: they never "
        "change during a round. Use 1 for training sets."
    ),
]
Scenes = Annotated[
    int,
    Option(
        help="Number of different scenes (scenery with light and weather) in a round, which "
        "are shown in turn. Only with --stretch, which sets the number of frames between "
        f"two changes. 0: one scene per {FRAMES_PER_SCENE} frames of the round, at least "
        "one."
    ),
]
SplitName = Annotated[
    str,
    Option(
        help="unseen: record only rounds for tests on tracks that are not used for training, by "
        "default on the four unseen tracks. Default: record rounds for training and for "
        "testing."
    ),
]


@dataclass(frozen=True)
class CollectConfig:
    """Options of `datagen collect`. The constructor raises UserError for impossible values."""

    rounds: Rounds = 60
    frames: Frames = 2000
    seed: Seed = 0
    tracks: tuple[TrackChoice, ...] = field(kw_only=True)
    lanes: tuple[int, ...] = (1, 2, 3)
    lights: tuple[str, ...] = field(default_factory=all_lights)
    test_share: TestShare = 0.25
    codec: Annotated[
        str, Option(help="Format of the images: jpeg (quality 95 of 100) or png (lossless).")
    ] = "jpeg"
    frequency_hz: Annotated[
        int,
        Option(
            "--frequency",
            help="Number of recorded frames per second of the drive, a divisor of 200. The car is "
            "controlled at 20 Hz or faster even if this number is smaller.",
        ),
    ] = 20
    camera: CameraParameters = field(default_factory=CameraParameters)
    stretch: Stretch = 0
    scenes: Scenes = 0
    jitter_camera: Annotated[
        bool,
        Option(
            "--jitter-camera",
            help="Give the camera of each round a random height (up to 0.08 m higher or lower), "
            "pitch (up to 1.5 degrees more or less) and vertical field of view (up to 3 "
            "degrees more or less).",
        ),
    ] = False
    roads: Annotated[
        str,
        Option(
            help="Kind of the roads. paper: lanes of 4.0 m, as in the paper by Li et al. on "
            "lateral control, and the tracks' own lane markings. varied: width of the "
            "lanes, shoulders, style of the lane markings and camera height are random "
            "for each round, and road surface, wear of the markings and light for each "
            "scene."
        ),
    ] = "paper"
    poses: Annotated[
        str,
        Option(
            help="Poses of the car. driven: the scripted driver drives. placed: in each frame the "
            "car stands at another random place, offset from the middle and angle to the road; "
            "bends of a rare radius are more frequent than on the road, and the angle does not "
            "depend on the curvature."
        ),
    ] = "driven"
    prefix: Annotated[
        str,
        Option(
            help="First part of the rounds' names. `datagen merge` merges datasets that have "
            "been recorded with different --prefix and --seed."
        ),
    ] = "round"
    split: SplitName = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the options by name. An option that did not exist in earlier versions (key of
        `LATER`) is left out if it has its default."""
        options = asdict(self, dict_factory=stored)
        for track in options["tracks"]:  # the entries of the rounds have it
            del track["picture_hash"]
        return {k: v for k, v in options.items() if k not in LATER or v != LATER[k]}

    def round_id(self, number: int) -> str:
        """Return the name of round `number` (from 0): the prefix and the number."""
        return f"{self.prefix}-{number:0{max(3, len(str(self.rounds - 1)))}d}"

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
        if not 0 <= self.seed <= MAX_SEED:
            raise UserError(f"the seed is {self.seed}; give a whole number from 0 to {MAX_SEED}")
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
            ("poses", (self.poses,), POSES),
        ):
            if unknown := set(given) - set(known):
                raise UserError(f"unknown {name} {min(unknown)!r}; choose {', '.join(known)}")
        require_name(self.prefix, "prefix of the rounds' names")
        require_name(self.round_id(self.rounds - 1), "last round's name, --prefix and a number,")
        if self.split not in ("", UNSEEN):
            raise UserError(f"there is no split {self.split!r} to collect; give {UNSEEN} or none")


LATER = {name: getattr(CollectConfig, name) for name in ("roads", "poses", "prefix")}
"""Defaults of options that did not exist when earlier versions wrote their plans."""


@dataclass(frozen=True)
class ProtocolConfig:
    """Options of `datagen protocol`. By default 15 rounds of 2,000 images are recorded, as many
    images as the paper has. The constructor raises UserError unless `laps` is above 0 and at
    most 1000 (MAX_LAPS)."""

    rounds: Annotated[int, Option(help="Number of rounds on the nine tracks.")] = 15
    frames: Annotated[int, Option(help="Number of frames in each round on the nine tracks.")] = 2000
    laps: Annotated[
        float,
        Option(
            help="Number of laps of each of the four drives on g-track-3 and dirt-3, above 0 to "
            "1000."
        ),
    ] = 1.0
    seed: Seed = 1810

    def __post_init__(self) -> None:
        if not 0 < self.laps <= MAX_LAPS:
            raise UserError(f"{self.laps:g} laps asked for; give above 0 to {MAX_LAPS}, such as 1")
