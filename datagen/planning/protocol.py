"""The plan of the paper's protocol (Li et al., section VII): the test data of its perception.

Four laps near the middle of a one-lane road at 20 Hz, on g-track-3 and on dirt-3, in clear light
and in heavy shadow, without traffic; and rounds on its nine tracks with one, two and three lanes,
other cars and all trajectories. All of them are for tests.
"""

from dataclasses import replace
from math import ceil
from pathlib import Path

from datagen.planning.class_balance import TrackForecast
from datagen.planning.config import CollectConfig, ProtocolConfig
from datagen.planning.plan import Plan, RoundPlan
from datagen.planning.planner import make_plan
from datagen.planning.tracks import HELD_OUT, choose_tracks
from datagen.recording.names import MIDDLE, UNSEEN
from simulator.driving.speed import speed_profile
from simulator.track.catalogue import find_track

NINE_TRACKS = (
    "alpine-1", "alpine-2", "e-track-2", "e-track-3", "eroad", "forza",
    "g-track-1", "g-track-2", "g-track-3",
)  # fmt: skip
"""The paper names alpine-1, alpine-2, e-track-3, eroad, forza and g-track-3; it has nine."""
DRIVEN_TRACKS = ("g-track-3", "dirt-3")
LIGHTS = ("clear", "heavy-shadow")
SPEED_KMH = 65.0  # the paper's vehicles: 60 to 75 km/h


def protocol_plan(config: ProtocolConfig, tracks_dir: Path | None) -> Plan:
    """The plan; the rounds of the nine tracks come first, then the drives.

    Raises UnknownTrack where a track of TORCS is not found.
    """
    collection = CollectConfig(
        rounds=config.rounds,
        frames=config.frames,
        seed=config.seed,
        tracks=choose_tracks(NINE_TRACKS, tracks_dir),
        lights=LIGHTS,
    )
    plan = make_plan(collection, TrackForecast.of(collection.tracks, tracks_dir))
    rounds = [replace(entry, split="test") for entry in plan.rounds]
    cases = [(track, light) for track in DRIVEN_TRACKS for light in LIGHTS]
    seed = rounds[-1].seed + 1
    drives = [
        _drive(rounds[0], track, light, seed + number, config.laps, tracks_dir)
        for number, (track, light) in enumerate(cases)
    ]
    return replace(plan, rounds=(*rounds, *drives))


def _drive(
    like: RoundPlan, track: str, light: str, seed: int, laps: float, tracks_dir: Path | None
) -> RoundPlan:
    """A drive of `laps` laps from the start line; its other values are those of `like`."""
    geometry = find_track(track, tracks_dir)
    profile = speed_profile(geometry, SPEED_KMH / 3.6, innermost_y=0.0)
    lap_s = float((profile.cell_m / profile.limit).sum())
    return replace(
        like,
        id=f"drive-{track}-{light}",
        seed=seed,
        split=UNSEEN if track in HELD_OUT else "test",
        track=track,
        track_hash=geometry.content_hash,
        lanes=1,
        traffic=0,
        trajectory=MIDDLE,
        lights=(light,),
        stretch=0,
        speed_kmh=SPEED_KMH,
        start=0.0,
        frames=ceil(laps * lap_s * like.frequency_hz),
    )
