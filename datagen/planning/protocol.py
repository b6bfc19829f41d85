"""Makes the plan of the paper's test data for perception (Li et al., section VII).

It has four drives near the middle of a one-lane road without traffic at 20 Hz: on g-track-3 and on
dirt-3, each in clear light and in heavy shadow. It also has rounds on the paper's nine tracks with
one, two and three lanes, other cars and all trajectories. No round is for training.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from datagen.driving.scripted_driver import ScriptedDriver
from datagen.driving.trajectory import make_course
from datagen.planning.class_balance import TrackForecast
from datagen.planning.config import CollectConfig, ProtocolConfig
from datagen.planning.plan import Plan, RoundPlan
from datagen.planning.planner import make_plan
from datagen.planning.tracks import HELD_OUT, choose_tracks
from datagen.recording.names import MIDDLE, UNSEEN
from simulator.track.catalogue import find_track
from simulator.track.geometry import Track
from simulator.track.road import Road
from simulator.world.world import World

NINE_TRACKS = (
    "alpine-1", "alpine-2", "e-track-2", "e-track-3", "eroad", "forza",
    "g-track-1", "g-track-2", "g-track-3",
)  # fmt: skip
"""The paper uses nine tracks and names six of them: alpine-1, alpine-2, e-track-3, eroad, forza and
g-track-3. The other three are our choice."""
DRIVEN_TRACKS = ("g-track-3", "dirt-3")
LIGHTS = ("clear", "heavy-shadow")
SPEED_KMH = 65.0  # the paper's vehicles drive at 60 to 75 km/h


def protocol_plan(config: ProtocolConfig, tracks_dir: Path | None) -> Plan:
    """Make the plan: first the rounds on the paper's nine tracks, then its drives on g-track-3 and
    dirt-3, each in clear light and in heavy shadow.

    Raises UnknownTrack if a track of TORCS is not found.
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
    drives: list[RoundPlan] = []
    for name in DRIVEN_TRACKS:
        track = find_track(name, tracks_dir)
        frames = drive_frames(track, config.laps, rounds[0].frequency_hz)
        for light in LIGHTS:
            seed = rounds[-1].seed + 1 + len(drives)
            drives.append(_drive(rounds[0], track, light, seed, frames))
    return replace(plan, rounds=(*rounds, *drives))


def _drive(like: RoundPlan, track: Track, light: str, seed: int, frames: int) -> RoundPlan:
    """Return the entry of a drive of `frames` frames from the start line. Values that all drives
    and rounds of the plan share are taken from the round `like`."""
    return replace(
        like,
        id=f"drive-{track.name}-{light}",
        seed=seed,
        split=UNSEEN if track.name in HELD_OUT else "test",
        track=track.name,
        track_hash=track.content_hash,
        picture_hash=track.picture_hash,
        lanes=1,
        traffic=0,
        trajectory=MIDDLE,
        lights=(light,),
        stretch=0,
        speed_kmh=SPEED_KMH,
        start=0.0,
        frames=frames,
    )


def drive_frames(track: Track, laps: float, frequency_hz: int) -> int:
    """Return the number of frames in which the scripted driver drives `laps` laps from the start
    line, at `frequency_hz` frames per second.

    The drive is simulated without images. The speed profile alone would give up to 11 % fewer
    frames, because the driver brakes for limits 0.5 s ahead and accelerates after each bend.
    """
    road, speed = Road(track, 1), SPEED_KMH / 3.6
    course = make_course(MIDDLE, road, laps * track.length_m, np.random.default_rng(0))
    driver = ScriptedDriver(road, course, speed, frequency_hz)
    frames, driven_m = 0, 0.0
    with World(road, frequency_hz=frequency_hz) as world:
        state = world.reset(
            seed=0, s=0.0, to_middle=driver.offset_at(0.0), speed=driver.speed_at(0.0)
        )
        while state.lap + state.s / track.length_m < laps:
            state = world.step(driver.command(state, world.traffic, driven_m))
            driven_m += state.speed / frequency_hz
            frames += 1
    return frames
