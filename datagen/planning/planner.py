"""Makes a plan from the options. One seed determines all random choices.

Tracks, lane counts, traffic, trajectories, lights and speeds are stratified, so that a short plan
covers as many values as it can.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

import trackfeatures as tf
from datagen.driving.trajectory import TRAJECTORIES
from datagen.planning.class_balance import TrackForecast, balance_starts
from datagen.planning.config import FRAMES_PER_SCENE, SEEDS_PER_PLAN, CollectConfig, TrackChoice
from datagen.planning.plan import Plan, RoundPlan
from datagen.planning.split import choose_test_rounds
from datagen.recording.names import PLACED, UNSEEN
from simulator.track.random_roads.road import RANDOM, random_name, random_track
from simulator.varied.round import VariedRound
from trackfeatures.camera import CameraParameters

MAX_TRAFFIC = 8
SPEED_KMH = (40.0, 75.0)
CAMERA_JITTER = {"z": 0.08, "pitch_deg": 1.5, "fov_y_deg": 3.0}  # half widths in m, deg, deg

Value = TypeVar("Value")


def make_plan(config: CollectConfig, forecast: TrackForecast | None = None) -> Plan:
    """Make the plan of these options; the same options always give the same plan.

    With a `forecast`, a round has at most as many other cars as fit on its road, and the starts of
    the rounds are chosen so that no class of the road is rare.
    """
    # The order of the random choices below determines every plan: changing it changes all datasets.
    rng = np.random.default_rng([config.seed, 0])
    count = config.rounds
    tracks, lanes = _tracks_and_lanes(config, rng)
    traffic = stratified_shuffle(range(MAX_TRAFFIC + 1), count, rng)
    kinds = (PLACED,) if config.poses == PLACED else TRAJECTORIES
    trajectories = stratified_shuffle(kinds, count, rng)
    lights = _lights(config, rng)
    speeds = _stratified_uniform(count, rng) * (SPEED_KMH[1] - SPEED_KMH[0]) + SPEED_KMH[0]
    starts = _starts(tracks, rng)
    if config.split:
        splits = [config.split] * count
    else:
        names = [track.name for track in tracks]
        test = choose_test_rounds(config.test_share, names, lanes, (trajectories, lights), rng)
        splits = ["test" if number in test else "train" for number in range(count)]
    cameras = _cameras(config, rng)
    roads = _roads(config, lanes, lights)
    rounds = tuple(
        RoundPlan(
            id=config.round_id(number),
            seed=_first_seed(config) + number,
            split=splits[number],
            track=tracks[number].name,
            track_hash=tracks[number].content_hash,
            lanes=lanes[number],
            traffic=traffic[number],
            trajectory=trajectories[number],
            lights=lights[number],
            stretch=config.stretch,
            speed_kmh=round(float(speeds[number]), 2),
            start=round(starts[number], 5),
            frames=config.frames,
            frequency_hz=config.frequency_hz,
            codec=config.codec,
            camera=_mounted(cameras[number], roads[number]),
            nominal_camera=config.camera,
            lane_width_m=_lane_width(roads[number]),
            varied=roads[number],
            picture_hash=tracks[number].picture_hash,
        )
        for number in range(count)
    )
    if forecast is not None:
        rounds = balance_starts([forecast.with_fitting_traffic(e) for e in rounds], forecast)
    return Plan(config, rounds)


def stratified_shuffle(
    values: Sequence[Value], count: int, rng: np.random.Generator
) -> list[Value]:
    """Return `count` values: all of `values` in random order, then all of them again in another
    random order, and so on.

    The numbers of occurrences of two elements of `values` differ by at most one.
    """
    shuffled: list[Value] = []
    while len(shuffled) < count:
        shuffled += [values[i] for i in rng.permutation(len(values))]
    return shuffled[:count]


def _stratified_uniform(
    count: int, rng: np.random.Generator
) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Random numbers (count,): one from each of `count` equal parts of [0, 1), in random order."""
    return (rng.permutation(count) + rng.uniform(size=count)) / count


def _first_seed(config: CollectConfig) -> int:
    """Seed of the first round. Rounds of the split `unseen` share no seed with train and test."""
    return config.seed * SEEDS_PER_PLAN + (SEEDS_PER_PLAN // 2 if config.split == UNSEEN else 0)


def _cameras(config: CollectConfig, rng: np.random.Generator) -> list[CameraParameters]:
    if not config.jitter_camera:
        return [config.camera] * config.rounds
    nominal = config.camera
    drawn = {name: _stratified_uniform(config.rounds, rng) for name in CAMERA_JITTER}
    return [
        replace(
            nominal,
            **{
                name: round(getattr(nominal, name) + half * (2.0 * float(drawn[name][k]) - 1.0), 4)
                for name, half in CAMERA_JITTER.items()
            },
        )
        for k in range(config.rounds)
    ]


def _roads(
    config: CollectConfig, lanes: Sequence[int], lights: Sequence[tuple[str, ...]]
) -> list[VariedRound | None]:
    """Return the random values of the road of each round, from the round's seed, its number of
    lanes (`lanes`) and the lights of its scenes (`lights`). They are None on the paper's roads."""
    if config.roads == "paper":
        return [None] * config.rounds
    first, height_m = _first_seed(config), config.camera.height_above_road_m
    return [
        VariedRound.drawn(first + k, lanes[k], len(lights[k]), height_m)
        for k in range(config.rounds)
    ]


def _mounted(camera: CameraParameters, road: VariedRound | None) -> CameraParameters:
    """Return `camera` at the random height of the varied road `road`. If `road` is None (the
    paper's roads), return `camera` unchanged."""
    if road is None:
        return camera
    height = road.carriageway.camera_height_m
    return replace(camera, z=round(height - CameraParameters.cg_height_m, 4))


def _lane_width(road: VariedRound | None) -> float:
    return tf.LANE_WIDTH_M if road is None else road.carriageway.lane_width_m


def _tracks_and_lanes(
    config: CollectConfig, rng: np.random.Generator
) -> tuple[list[TrackChoice], list[int]]:
    """Track and lane count of each round. The rounds cycle through the tracks, and the rounds of a
    track cycle through the lane counts."""
    order = rng.permutation(len(config.tracks))
    first = rng.permutation(len(config.tracks))
    tracks, lanes = [], []
    for number in range(config.rounds):
        cycle, place = divmod(number, len(order))
        tracks.append(_track(config.tracks[order[place]], _first_seed(config) + number))
        lanes.append(config.lanes[(cycle + int(first[place])) % len(config.lanes)])
    return tracks, lanes


def _track(choice: TrackChoice, round_seed: int) -> TrackChoice:
    """Return `choice`; for the name `random`, the random road that `round_seed` determines."""
    if choice.name != RANDOM:
        return choice
    track = random_track(random_name(round_seed))
    return TrackChoice(track.name, track.content_hash, track.picture_hash)


def _lights(config: CollectConfig, rng: np.random.Generator) -> list[tuple[str, ...]]:
    """Names of the lights of each round's scenes, stratified over all scenes of the plan."""
    stretches = -(-config.frames // config.stretch) if config.stretch else 1
    scenes = min(stretches, config.scenes or max(1, config.frames // FRAMES_PER_SCENE))
    lights = stratified_shuffle(config.lights, config.rounds * scenes, rng)
    return [tuple(lights[scenes * k : scenes * (k + 1)]) for k in range(config.rounds)]


def _starts(tracks: Sequence[TrackChoice], rng: np.random.Generator) -> list[float]:
    """Return the start of each round as a share of the lap, [0, 1). `tracks` has the track of each
    round. The starts of rounds on the same track follow a golden-ratio sequence, which spreads them
    evenly."""
    golden = 0.6180339887498949
    first = {choice.name: rng.uniform() for choice in dict.fromkeys(tracks)}
    rounds_on: dict[str, int] = {}
    starts = []
    for choice in tracks:
        number = rounds_on.get(choice.name, 0)
        rounds_on[choice.name] = number + 1
        starts.append(float((first[choice.name] + number * golden) % 1.0))
    return starts
