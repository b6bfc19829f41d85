"""What is to be recorded: one entry a round, all of it known before the first frame.

A round is a pure function of its entry. `datagen.planning.planner` makes the entries.
"""

import hashlib
import json
import re
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import Any

import trackfeatures as tf
from datagen.driving.trajectory import KINDS as TRAJECTORIES
from datagen.recording.images import CODECS
from datagen.recording.splits import UNSEEN
from simulator.camera import KINDS as LIGHTS
from simulator.world.control_rate import PHYSICS_HZ, check_frequency
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

TEST_SHARE = 0.25
CONTROL_HZ = 20
FRAMES_A_SCENE = 200  # to build one takes as long as some fifteen frames
SEEDS_A_PLAN = 1_000_000
MOST_ROUNDS = SEEDS_A_PLAN // 2  # before its seeds meet those of another plan

__all__ = ["LIGHTS", "TRAJECTORIES", "CollectConfig", "Plan", "RoundPlan", "TrackChoice"]


def program() -> str:
    """What records: another version of it may draw or drive the same round otherwise."""
    return f"driverview {version('driverview')}"


@dataclass(frozen=True, slots=True)
class TrackChoice:
    """A track by the name it is found under, and what it looked like when the plan was made."""

    name: str
    content_hash: str


@dataclass(frozen=True, slots=True)
class CollectConfig:
    """What the user asked for."""

    rounds: int
    frames: int
    seed: int
    tracks: tuple[TrackChoice, ...]
    lanes: tuple[int, ...] = (1, 2, 3)
    lights: tuple[str, ...] = LIGHTS
    test_share: float = TEST_SHARE
    codec: str = "jpeg"
    frequency_hz: int = 20
    """Of the frames; the car is steered at `CONTROL_HZ` or more."""
    camera: CameraParameters = field(default_factory=CameraParameters)
    stretch: int = 0
    """After so many frames the scenery and the light are others; 0: never in a round."""
    scenes: int = 0
    """A round shows so many in turn, again and again; 0: one for every `FRAMES_A_SCENE`."""
    jitter_camera: bool = False
    """Each round looks from a place, pitch and lens a little different from `camera`."""
    split: str = ""
    """"unseen": all rounds are for testing what was never trained on. Else: train and test."""

    def __post_init__(self) -> None:
        if not 1 <= self.rounds <= MOST_ROUNDS or self.frames < 1:
            raise tf.UserError(
                f"{self.rounds} rounds of {self.frames} frames asked for; ask for at least one "
                f"each, and for {MOST_ROUNDS} rounds at most"
            )
        if self.stretch < 0:
            raise tf.UserError(
                f"a stretch of {self.stretch} frames; give how many frames the scenery lasts, or 0 "
                "for the whole round"
            )
        if self.scenes < 0:
            raise tf.UserError(
                f"{self.scenes} scenes a round; give at least 1, or 0 for one for every "
                f"{FRAMES_A_SCENE} frames"
            )
        if self.seed < 0:
            raise tf.UserError(f"the seed is {self.seed}; give a whole number from 0 up")
        check_frequency(self.frequency_hz)
        for lanes in self.lanes:
            tf.check_lanes(lanes, tf.LANE_WIDTH_M)
        if not (self.lanes and self.tracks and self.lights):
            raise tf.UserError("no tracks, lanes or lights given; name at least one of each")
        for name, found, known in (
            ("light", self.lights, LIGHTS),
            ("codec", (self.codec,), CODECS),
        ):
            if unknown := set(found) - set(known):
                raise tf.UserError(f"unknown {name} {min(unknown)!r}; choose {', '.join(known)}")
        if self.split not in ("", UNSEEN):
            raise tf.UserError(f"there is no split {self.split!r} to collect; the one is {UNSEEN}")
        if not 0.0 <= self.test_share < 1.0:
            raise tf.UserError(f"a test share of {self.test_share}; give 0 to below 1, e.g. 0.25")


@dataclass(frozen=True, slots=True)
class RoundPlan:
    """Everything that makes one round what it is."""

    id: str
    seed: int
    split: str
    track: str
    track_hash: str
    lanes: int
    traffic: int
    trajectory: str
    lights: tuple[str, ...]
    """Of each scene; its stretches show them in turn, again and again where they are more."""
    stretch: int
    """Frames; 0: the round is one stretch."""
    speed_kmh: float
    start: float
    """Where on the lap it starts, as a share of its length."""
    frames: int
    frequency_hz: int
    codec: str
    camera: CameraParameters
    nominal_camera: CameraParameters
    """The dataset's camera, of which `camera` may be a jittered copy."""
    lane_width_m: float = tf.LANE_WIDTH_M

    @property
    def steps_a_frame(self) -> int:
        """Control steps from one frame to the next: the car is steered at least 20 times a second,
        at a rate that the physics' divides by."""
        least = -(-CONTROL_HZ // self.frequency_hz)
        whole = PHYSICS_HZ // self.frequency_hz
        return next(steps for steps in range(least, whole + 1) if whole % steps == 0)

    @staticmethod
    def from_json(entry: dict[str, Any]) -> "RoundPlan":
        """Raises KeyError or TypeError where the entry is not one of this program."""
        cameras = {key: CameraParameters(**entry[key]) for key in ("camera", "nominal_camera")}
        return RoundPlan(**{**entry, **cameras, "lights": tuple(entry["lights"])})


@dataclass(frozen=True, slots=True)
class Plan:
    wanted: CollectConfig
    rounds: tuple[RoundPlan, ...]

    @property
    def hash(self) -> str:
        """SHA-256 (hex) of all entries, the program and the definitions they are measured by."""
        content = [tf.VERSION, program(), [asdict(entry) for entry in self.rounds]]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def as_json(self) -> dict[str, Any]:
        return {
            "hash": self.hash,
            "definitions": tf.VERSION,
            "program": program(),
            "wanted": asdict(self.wanted),
            "rounds": [asdict(entry) for entry in self.rounds],
        }


# A part of a plan, for batch systems: `--shard 2/4` records every fourth round from the second.


@dataclass(frozen=True, slots=True)
class Shard:
    """Number `number` (from 1) of `count`."""

    number: int
    count: int

    @staticmethod
    def parse(text: str) -> "Shard":
        found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text.strip())
        shard = Shard(int(found[1]), int(found[2])) if found else Shard(0, 0)
        if not 1 <= shard.number <= shard.count:
            raise UserError(f"--shard is {text!r}; give its number and how many, as 1/4 to 4/4")
        return shard

    def of(self, rounds: tuple[RoundPlan, ...]) -> tuple[RoundPlan, ...]:
        return rounds[self.number - 1 :: self.count]

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"
