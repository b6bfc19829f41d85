"""The plan of a dataset: one entry for each round, fixed before the first frame is recorded.

An entry determines its round completely. `datagen.planning.planner` makes the entries.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from typing import Any

import trackfeatures as tf
from datagen.planning.config import CollectConfig
from simulator.varied.round import VariedRound
from simulator.world.control_rate import PHYSICS_HZ
from trackfeatures.camera import CameraParameters, stored
from trackfeatures.errors import UserError
from trackfeatures.names import require_name

CONTROL_HZ = 20
"""Lowest rate of control steps, Hz; at a lower frame rate there are several steps per frame."""
DRIVER_FILES = "files"
"""Key of a plan's driver: a hash of the files of the controller and the model. Plans of earlier
versions do not have this key."""


def program() -> str:
    """Return name and version of this program. A plan's hash contains them, because another version
    can record the same round differently."""
    return f"driverview {version('driverview')}"


def changed_track(
    entries: Iterable[dict[str, Any]], others: Iterable[dict[str, Any]]
) -> str | None:
    """Return the name of a track whose surface, scenery or paint differs between two lists of
    rounds' entries in plans of equal hash; None if there is none. An entry of an earlier version
    has no hash of them, and counts as equal."""
    known = {entry["id"]: entry.get("picture_hash") for entry in entries}
    for entry in others:
        pair = known.get(entry["id"]), entry.get("picture_hash")
        if all(pair) and pair[0] != pair[1]:
            return str(entry["track"])
    return None


def check_entry(entry: dict[str, Any]) -> str:
    """Return the id of a round's entry in `plan.json`. Raises BadName if the id cannot be a file
    name, and KeyError if it is missing."""
    return require_name(entry["id"], "round id")


@dataclass(frozen=True, slots=True)
class RoundPlan:
    """The entry of one round in the plan: all values that determine the recorded round."""

    id: str
    seed: int
    split: str
    track: str
    track_hash: str
    lanes: int
    traffic: int
    """Number of other cars."""
    trajectory: str
    lights: tuple[str, ...]
    """Name of the light of each scene. A round shows its scenes in order, again and again."""
    stretch: int
    """Number of frames between two changes of the scene; 0: the scene never changes."""
    speed_kmh: float
    start: float
    """Start position on the lap, as a share of its length."""
    frames: int
    frequency_hz: int
    codec: str
    camera: CameraParameters
    nominal_camera: CameraParameters
    """The dataset's camera; `camera` may be a jittered copy of it."""
    lane_width_m: float = tf.LANE_WIDTH_M
    varied: VariedRound | None = None
    """The random values of a varied road; None on the paper's roads."""
    picture_hash: str = ""
    """Hash of the track's geometry, surface, scenery and paint; "" in a plan of an earlier version,
    which has only `track_hash`."""

    def as_dict(self) -> dict[str, Any]:
        """Return the entry as it is written to `plan.json`. Two keys, which earlier versions did
        not have, can be missing: `varied` on the paper's roads, and an unknown `picture_hash`."""
        entry = asdict(self, dict_factory=stored)
        if self.varied is None:
            del entry["varied"]
        if not self.picture_hash:
            del entry["picture_hash"]
        return entry

    @property
    def steps_per_frame(self) -> int:
        """Number of control steps from one frame to the next: the smallest number for which the
        rate of control steps is at least 20 Hz (CONTROL_HZ) and divides the physics rate of 200 Hz.
        """
        least = -(-CONTROL_HZ // self.frequency_hz)
        most = PHYSICS_HZ // self.frequency_hz
        return next(steps for steps in range(least, most + 1) if most % steps == 0)

    @staticmethod
    def from_json(entry: dict[str, Any]) -> "RoundPlan":
        """Read an entry of `plan.json`. Raises KeyError, TypeError or ValueError if this version
        did not write it."""
        check_entry(entry)
        cameras = {key: CameraParameters(**entry[key]) for key in ("camera", "nominal_camera")}
        varied = VariedRound.from_dict(entry["varied"]) if "varied" in entry else None
        lights = tuple(entry["lights"])
        return RoundPlan(**{**entry, **cameras, "lights": lights, "varied": varied})


@dataclass(frozen=True, slots=True)
class Plan:
    """The options of a collection and the rounds that follow from them."""

    config: CollectConfig
    rounds: tuple[RoundPlan, ...]
    driver: Mapping[str, str] = field(default_factory=dict)
    """Controller, hash of the model's weights and hash of the files of both, if they drive instead
    of the scripted driver. They are part of the plan's hash, because the rounds depend on them."""

    @property
    def hash(self) -> str:
        """SHA-256 (hex) of all entries, the driver, the program and the definitions' version. The
        hashes of pictures are left out, so that a plan keeps the hash of earlier versions."""
        entries = [replace(entry, picture_hash="").as_dict() for entry in self.rounds]
        content: list[Any] = [tf.VERSION, program(), entries]
        if self.driver:
            content.append(dict(self.driver))
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def as_json(self) -> dict[str, Any]:
        """Return the content of `plan.json`. The key "wanted" holds the options."""
        driver = {"driver": dict(self.driver)} if self.driver else {}
        return {
            "hash": self.hash,
            "definitions": tf.VERSION,
            "program": program(),
            "wanted": self.config.as_dict(),
            **driver,
            "rounds": [entry.as_dict() for entry in self.rounds],
        }


@dataclass(frozen=True, slots=True)
class Shard:
    """Part `number` (from 1) of `count` parts of a plan, for batch systems.

    `--shard 2/4` records every fourth round, starting at the second.
    """

    number: int
    count: int

    @staticmethod
    def parse(text: str) -> "Shard":
        """Read a text like "2/4" (number/count). Raises UserError for other text."""
        match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text.strip())
        shard = Shard(int(match[1]), int(match[2])) if match else Shard(0, 0)
        if not 1 <= shard.number <= shard.count:
            raise UserError(f"--shard is {text!r}; give its number and how many, as 1/4 to 4/4")
        return shard

    def select(self, rounds: tuple[RoundPlan, ...]) -> tuple[RoundPlan, ...]:
        return rounds[self.number - 1 :: self.count]

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"
