"""Errors of `mtlnet calibrate FILM` on rendered films of known mounts.

Run: `python benchmarks/calibration.py [--films 10] [--seconds 60] [--keep FOLDER] [--json FILE]`.
Claim: pitch and yaw within 0.3 degrees, height within 5 % (lane width known), for ten random mounts
on roads with curves and hills. A film has ten frames a second: the calibration itself reads no more
of a film of 25 or 30 (`mtlnet.calibration.film.SAMPLE_S`). Afterwards, where
`../shared/real_roads` is: the pitch of one drive's pictures against the horizon of their labels.
"""

import argparse
import json
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("LP_NUM_THREADS", "0")  # before Mesa reads it: draw in this thread

import numpy as np

from datagen.driving.scripted_driver import ScriptedDriver
from datagen.driving.trajectory import make_course
from runtime.film import Film
from simulator.camera import Camera, Light
from simulator.camera.core.optics import rotation
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World
from trackfeatures.camera import CameraParameters

FPS = 10
SIZE = (640, 360)
TRACKS = ("countryside", "highway", "coast", "ring-road", "forest")
LIGHTS = ("clear", "overcast")
LANE_WIDTHS_M = (3.0, 4.2)
SPEEDS_KMH = (50.0, 75.0)


@dataclass(frozen=True)
class Mount:
    """A camera's lens and mount, and the road it films. Angles in degrees."""

    pitch_deg: float
    yaw_deg: float
    roll_deg: float
    height_m: float
    fov_y_deg: float
    track: str
    lanes: int
    lane_width_m: float
    light: str
    speed_kmh: float
    start: float
    """Share of the lap."""


def random_mount(seed: int) -> Mount:
    rng = np.random.default_rng([seed, 35])
    return Mount(
        *(float(rng.uniform(-most, most)) for most in (6.0, 4.0, 2.0)),
        height_m=float(rng.uniform(1.0, 1.8)),
        fov_y_deg=float(rng.uniform(40.0, 80.0)),
        track=TRACKS[seed % len(TRACKS)],
        lanes=int(rng.integers(1, 4)),
        lane_width_m=float(rng.uniform(*LANE_WIDTHS_M)),
        light=LIGHTS[int(rng.integers(len(LIGHTS)))],
        speed_kmh=float(rng.uniform(*SPEEDS_KMH)),
        start=float(rng.uniform()),
    )


def render_film(mount: Mount, path: Path, seconds: float, seed: int) -> None:
    """Film `seconds` of the scripted driver's drive from the camera of `mount`."""
    road = Road(find_track(mount.track), mount.lanes, mount.lane_width_m)
    course = make_course("lane", road, 25.0 * seconds, np.random.default_rng([seed, 36]))
    driver = ScriptedDriver(road, course, mount.speed_kmh / 3.6, FPS * 2)
    lens = CameraParameters(*SIZE, mount.fov_y_deg, x=0.0, y=0.0, z=0.0)
    turn = rotation(*np.radians([mount.roll_deg, mount.pitch_deg, mount.yaw_deg]))
    place = np.array([0.6, 0.0, mount.height_m - lens.cg_height_m])
    light = Light.named(mount.light, np.random.default_rng([seed, 37]))
    driven = 0.0
    with (
        World(road, traffic=4, frequency_hz=FPS * 2) as world,
        Camera(road, lens, seed=seed, light=light) as camera,
        Film(path, FPS) as film,
    ):
        s = mount.start * road.track.length_m
        state = world.reset(seed=seed, s=s, speed=driver.speed_at(s), to_middle=driver.offset_at(0))
        for step in range(int(seconds * FPS) * 2):
            if step % 2 == 0:
                pose = world.body_pose()
                body = rotation(*pose[3:])
                eye = np.concatenate([pose[:3] + body @ place, _euler(body @ turn)])
                film.write(camera.render(eye, world.traffic.poses()))
            state = world.step(driver.command(state, world.traffic, driven))
            driven += max(state.speed, 0.0) / (FPS * 2)


def _euler(turn: np.ndarray) -> tuple[float, float, float]:
    """Roll, pitch and yaw (rad) of a rotation, as `rotation` takes them."""
    return (
        float(np.arctan2(turn[2, 1], turn[2, 2])),
        float(-np.arcsin(turn[2, 0])),
        float(np.arctan2(turn[1, 0], turn[0, 0])),
    )


if __name__ == "__main__":
    import time

    folder = Path(sys.argv[1])
    folder.mkdir(exist_ok=True)
    for seed in range(int(sys.argv[2]), int(sys.argv[3])):
        m = random_mount(seed)
        t = time.time()
        render_film(m, folder / f"{seed}.mp4", float(sys.argv[4]), seed)
        (folder / f"{seed}.json").write_text(json.dumps(m.__dict__))
        print(seed, m, time.time() - t, flush=True)
