"""What is to be recorded: one entry a round, all of it drawn from one seed before the first frame.

Tracks, lane counts, traffic, trajectories, lights and speeds are spread evenly (each list is dealt
out like shuffled cards), so that a short plan covers as much as it can. A round is a pure function
of its entry.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, TypeVar

import numpy as np

import trackfeatures as tf
from datagen.recording.camera import CameraInfo
from datagen.recording.encoding import CODECS

TRAJECTORIES = ("lane", "offsets", "weave", "lane-changes", "recoveries")
LIGHTS = ("clear", "overcast", "dusk", "fog", "heavy-shadow")
MOST_TRAFFIC = 8
SPEED_KMH = (40.0, 75.0)
TEST_SHARE = 0.25
SEEDS_A_PLAN = 1_000_000  # rounds a plan may have before its seeds meet those of the next seed

Card = TypeVar("Card")


@dataclass(frozen=True, slots=True)
class TrackChoice:
    """A track by the name it is found under, and what it looked like when the plan was made."""

    name: str
    content_hash: str


@dataclass(frozen=True, slots=True)
class Wanted:
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
    camera: CameraInfo = field(default_factory=CameraInfo)

    def __post_init__(self) -> None:
        if not 1 <= self.rounds < SEEDS_A_PLAN or self.frames < 1:
            raise tf.UserError(
                f"{self.rounds} rounds of {self.frames} frames asked for; ask for at least one each"
            )
        if self.seed < 0:
            raise tf.UserError(f"the seed is {self.seed}; give a whole number from 0 up")
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
    light: str
    speed_kmh: float
    start: float
    """Where on the lap it starts, as a share of its length."""
    frames: int
    frequency_hz: int
    codec: str
    camera: CameraInfo
    lane_width_m: float = tf.LANE_WIDTH_M


@dataclass(frozen=True, slots=True)
class Plan:
    wanted: Wanted
    rounds: tuple[RoundPlan, ...]

    @property
    def hash(self) -> str:
        """SHA-256 (hex) of all entries and of the definitions they are measured by."""
        content = [tf.VERSION, [asdict(entry) for entry in self.rounds]]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def as_json(self) -> dict[str, Any]:
        return {
            "hash": self.hash,
            "definitions": tf.VERSION,
            "wanted": asdict(self.wanted),
            "rounds": [asdict(entry) for entry in self.rounds],
        }


def make_plan(wanted: Wanted) -> Plan:
    """The plan that belongs to these wishes, always the same one."""
    rng = np.random.default_rng([wanted.seed, 0])
    count = wanted.rounds
    tracks, lanes = _tracks_and_lanes(wanted, rng)
    traffic = _dealt(range(MOST_TRAFFIC + 1), count, rng)
    trajectories = _dealt(TRAJECTORIES, count, rng)
    lights = _dealt(wanted.lights, count, rng)
    speeds = _spread(count, rng) * (SPEED_KMH[1] - SPEED_KMH[0]) + SPEED_KMH[0]
    starts = _starts(tracks, rng)
    test = _test_rounds(wanted, tracks, (lanes, trajectories, lights), rng)
    digits = max(3, len(str(count - 1)))
    return Plan(
        wanted,
        tuple(
            RoundPlan(
                id=f"round-{number:0{digits}d}",
                seed=wanted.seed * SEEDS_A_PLAN + number,
                split="test" if number in test else "train",
                track=tracks[number].name,
                track_hash=tracks[number].content_hash,
                lanes=lanes[number],
                traffic=traffic[number],
                trajectory=trajectories[number],
                light=lights[number],
                speed_kmh=round(float(speeds[number]), 2),
                start=round(starts[number], 5),
                frames=wanted.frames,
                frequency_hz=wanted.frequency_hz,
                codec=wanted.codec,
                camera=wanted.camera,
            )
            for number in range(count)
        ),
    )


def _tracks_and_lanes(
    wanted: Wanted, rng: np.random.Generator
) -> tuple[list[TrackChoice], list[int]]:
    """Every track in turn, and for each track every lane count in turn."""
    order = rng.permutation(len(wanted.tracks))
    first = rng.permutation(len(wanted.tracks))
    tracks, lanes = [], []
    for number in range(wanted.rounds):
        turn, place = divmod(number, len(order))
        tracks.append(wanted.tracks[order[place]])
        lanes.append(wanted.lanes[(turn + int(first[place])) % len(wanted.lanes)])
    return tracks, lanes


def _dealt(cards: Sequence[Card], count: int, rng: np.random.Generator) -> list[Card]:
    """`count` cards from packs that are shuffled one after the other."""
    dealt: list[Card] = []
    while len(dealt) < count:
        dealt += [cards[i] for i in rng.permutation(len(cards))]
    return dealt[:count]


def _spread(count: int, rng: np.random.Generator) -> np.ndarray[Any, np.dtype[np.float64]]:
    """One number in each of `count` equal parts of [0, 1), shuffled."""
    return (rng.permutation(count) + rng.uniform(size=count)) / count


def _starts(tracks: Sequence[TrackChoice], rng: np.random.Generator) -> list[float]:
    """The rounds of a track start evenly around its lap."""
    golden = 0.6180339887498949
    first = {choice.name: rng.uniform() for choice in dict.fromkeys(tracks)}
    seen: dict[str, int] = {}
    starts = []
    for choice in tracks:
        turn = seen.get(choice.name, 0)
        seen[choice.name] = turn + 1
        starts.append(float((first[choice.name] + turn * golden) % 1.0))
    return starts


def _test_rounds(
    wanted: Wanted,
    tracks: Sequence[TrackChoice],
    others: Sequence[Sequence[Any]],
    rng: np.random.Generator,
) -> set[int]:
    """A share of all rounds: evenly over the tracks first, then over what `others` lists of each
    round (lanes, trajectory, light).

    Every track that has three rounds or more stands on both sides, even if that takes a few more
    test rounds than the share; no track gives its last round away while another has two.
    """
    if wanted.test_share == 0.0 or wanted.rounds < 2:
        return set()
    names = [choice.name for choice in tracks]
    counts = Counter(names)
    total = max(round(wanted.rounds * wanted.test_share), 1)
    total = max(total, sum(count >= 3 for count in counts.values()))
    total = min(total, wanted.rounds - 1)
    draw = rng.uniform(size=wanted.rounds)
    test: set[int] = set()

    def crowding(number: int) -> tuple[bool, float, float, float]:
        mine = _share(test, names, number)
        last = counts[names[number]] - round(mine * counts[names[number]]) == 1
        return last, mine, sum(_share(test, kind, number) for kind in others), draw[number]

    while len(test) < total:
        test.add(min(set(range(wanted.rounds)) - test, key=crowding))
    return test


def _share(test: set[int], kinds: Sequence[Any], number: int) -> float:
    """Share of the rounds of the same kind as `number` that are for testing already."""
    alike = [n for n, kind in enumerate(kinds) if kind == kinds[number]]
    return len(test.intersection(alike)) / len(alike)
