"""Dealing out a plan: everything a round may have, spread evenly from one seed.

Tracks, lane counts, traffic, trajectories, lights and speeds are dealt like shuffled cards, so
that a short plan covers as much as it can.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from datagen.planning.class_balance import Forecast, balanced
from datagen.planning.plan import (
    FRAMES_A_SCENE,
    SEEDS_A_PLAN,
    TRAJECTORIES,
    CollectConfig,
    Plan,
    RoundPlan,
    TrackChoice,
)
from datagen.recording.splits import UNSEEN
from trackfeatures.camera import CameraParameters

MOST_TRAFFIC = 8
SPEED_KMH = (40.0, 75.0)
# Half widths of what the camera's mounting varies by from round to round.
JITTER = {"z": 0.08, "pitch_deg": 1.5, "fov_y_deg": 3.0}  # m, deg, deg

Card = TypeVar("Card")


def make_plan(wanted: CollectConfig, forecast: Forecast | None = None) -> Plan:
    """The plan that belongs to these wishes, always the same one.

    With a `forecast` the rounds start where no class of the road ahead becomes rare.
    """
    rng = np.random.default_rng([wanted.seed, 0])
    count = wanted.rounds
    tracks, lanes = _tracks_and_lanes(wanted, rng)
    traffic = _dealt(range(MOST_TRAFFIC + 1), count, rng)
    trajectories = _dealt(TRAJECTORIES, count, rng)
    lights = _lights(wanted, rng)
    speeds = _spread(count, rng) * (SPEED_KMH[1] - SPEED_KMH[0]) + SPEED_KMH[0]
    starts = _starts(tracks, rng)
    sides = _sides(wanted, tracks, (lanes, trajectories, lights), rng)
    cameras = _cameras(wanted, rng)
    digits = max(3, len(str(count - 1)))
    rounds = tuple(
        RoundPlan(
            id=f"round-{number:0{digits}d}",
            seed=_first_seed(wanted) + number,
            split=sides[number],
            track=tracks[number].name,
            track_hash=tracks[number].content_hash,
            lanes=lanes[number],
            traffic=traffic[number],
            trajectory=trajectories[number],
            lights=lights[number],
            stretch=wanted.stretch,
            speed_kmh=round(float(speeds[number]), 2),
            start=round(starts[number], 5),
            frames=wanted.frames,
            frequency_hz=wanted.frequency_hz,
            codec=wanted.codec,
            camera=cameras[number],
            nominal_camera=wanted.camera,
        )
        for number in range(count)
    )
    return Plan(wanted, rounds if forecast is None else balanced(rounds, forecast))


def _first_seed(wanted: CollectConfig) -> int:
    """Rounds that were never trained on share no seed with those of the plan that is."""
    return wanted.seed * SEEDS_A_PLAN + (SEEDS_A_PLAN // 2 if wanted.split == UNSEEN else 0)


def _cameras(wanted: CollectConfig, rng: np.random.Generator) -> list[CameraParameters]:
    if not wanted.jitter_camera:
        return [wanted.camera] * wanted.rounds
    about = wanted.camera
    spread = {name: _spread(wanted.rounds, rng) for name in JITTER}
    return [
        replace(
            about,
            **{
                name: round(getattr(about, name) + half * (2.0 * float(spread[name][k]) - 1.0), 4)
                for name, half in JITTER.items()
            },
        )
        for k in range(wanted.rounds)
    ]


def _tracks_and_lanes(
    wanted: CollectConfig, rng: np.random.Generator
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


def _lights(wanted: CollectConfig, rng: np.random.Generator) -> list[tuple[str, ...]]:
    """The light of each scene of each round: every light before one comes again."""
    stretches = -(-wanted.frames // wanted.stretch) if wanted.stretch else 1
    each = min(stretches, wanted.scenes or max(1, wanted.frames // FRAMES_A_SCENE))
    dealt = _dealt(wanted.lights, wanted.rounds * each, rng)
    return [tuple(dealt[each * number : each * (number + 1)]) for number in range(wanted.rounds)]


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


def _sides(
    wanted: CollectConfig,
    tracks: Sequence[TrackChoice],
    others: Sequence[Sequence[Any]],
    rng: np.random.Generator,
) -> list[str]:
    if wanted.split:
        return [wanted.split] * wanted.rounds
    test = _test_rounds(wanted, tracks, others, rng)
    return ["test" if number in test else "train" for number in range(wanted.rounds)]


def _test_rounds(
    wanted: CollectConfig,
    tracks: Sequence[TrackChoice],
    others: Sequence[Sequence[Any]],
    rng: np.random.Generator,
) -> set[int]:
    """A share of all rounds: evenly over the tracks first, then over what `others` lists of each
    round (lanes, trajectory, light).

    Every track that has three rounds or more stands on both sides, even if that takes a few more
    test rounds than the share; no track gives its last round away while another has two, nor its
    last one of so many lanes: a road that was never trained on is what `unseen` rounds are for.
    """
    if wanted.test_share == 0.0 or wanted.rounds < 2:
        return set()
    names = [choice.name for choice in tracks]
    roads = list(zip(names, others[0], strict=True))
    counts = Counter(names)
    total = max(round(wanted.rounds * wanted.test_share), 1)
    total = max(total, sum(count >= 3 for count in counts.values()))
    total = min(total, wanted.rounds - 1)
    draw = rng.uniform(size=wanted.rounds)
    test: set[int] = set()

    def crowding(number: int) -> tuple[bool, bool, float, float, float]:
        mine = _share(test, names, number)
        last = counts[names[number]] - round(mine * counts[names[number]]) == 1
        left = sum(road == roads[number] for n, road in enumerate(roads) if n not in test)
        beside = sum(_share(test, kind, number) for kind in others)
        return last, left == 1, mine, beside, draw[number]

    while len(test) < total:
        test.add(min(set(range(wanted.rounds)) - test, key=crowding))
    return test


def _share(test: set[int], kinds: Sequence[Any], number: int) -> float:
    """Share of the rounds of the same kind as `number` that are for testing already."""
    alike = [n for n, kind in enumerate(kinds) if kind == kinds[number]]
    return len(test.intersection(alike)) / len(alike)
