"""The plan of a dataset: one entry for each round, fixed before the first frame.

A round is a pure function of its entry. `datagen.planning.planner` makes the entries.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
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
"""Lowest rate of control steps, Hz."""


def program() -> str:
    """Name and version of this program: another version may record the same round differently."""
    return f"driverview {version('driverview')}"


def check_entry(entry: dict[str, Any]) -> str:
    """The id of a round in a `plan.json`; raises BadName for a bad name, KeyError without one."""
    return require_name(entry["id"], "round id")


@dataclass(frozen=True, slots=True)
class RoundPlan:
    """All inputs of one round."""

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
    """Light of each scene. Stretches show the scenes in order and start again after the last."""
    stretch: int
    """Frames; 0: the whole round is one stretch."""
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

    def as_dict(self) -> dict[str, Any]:
        """The entry of `plan.json`; paper's roads have no key `varied`, as in earlier versions."""
        entry = asdict(self, dict_factory=stored)
        if self.varied is None:
            del entry["varied"]
        return entry

    @property
    def steps_per_frame(self) -> int:
        """Control steps from one frame to the next: the smallest number that gives at least
        `CONTROL_HZ` and a control rate by which `PHYSICS_HZ` can be divided."""
        least = -(-CONTROL_HZ // self.frequency_hz)
        most = PHYSICS_HZ // self.frequency_hz
        return next(steps for steps in range(least, most + 1) if most % steps == 0)

    @staticmethod
    def from_json(entry: dict[str, Any]) -> "RoundPlan":
        """Raises KeyError, TypeError or ValueError if `entry` was not made by this version."""
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
    """The driver, if it is not the scripted one; its rounds depend on it, so it is hashed, too."""

    @property
    def hash(self) -> str:
        """SHA-256 (hex) of all entries, the program and the version of the definitions."""
        content: list[Any] = [tf.VERSION, program(), [entry.as_dict() for entry in self.rounds]]
        if self.driver:
            content.append(dict(self.driver))
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def as_json(self) -> dict[str, Any]:
        """Content of `plan.json`; the options are under "wanted"."""
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
        """Read "2/4". Raises UserError for anything else."""
        match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text.strip())
        shard = Shard(int(match[1]), int(match[2])) if match else Shard(0, 0)
        if not 1 <= shard.number <= shard.count:
            raise UserError(f"--shard is {text!r}; give its number and how many, as 1/4 to 4/4")
        return shard

    def select(self, rounds: tuple[RoundPlan, ...]) -> tuple[RoundPlan, ...]:
        return rounds[self.number - 1 :: self.count]

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"
