"""Errors of `mtlnet calibrate FILM` on rendered films with known camera mounts.

Run: `python benchmarks/calibration.py [--films 10] [--seconds 60] [--keep FOLDER] [--json FILE]`.
Claim: pitch and yaw are within 0.3 degrees and the height is within 5 % for ten random mounts, on
roads with curves and hills and with known lane width. The films have 10 frames per second, because
the calibration reads at most 10 frames per second (`mtlnet.calibration.film.SAMPLE_S`). If the
folder `../shared/real_roads` exists, the pitch found from the pictures of one real drive is also
compared with the horizon in the labels of these pictures (limit 0.5 degrees).
"""

import csv
import math
import os
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("LP_NUM_THREADS", "0")  # before Mesa reads it: draw in this thread

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from numpy.typing import NDArray

from benchmarks.claims.outcome import conclude, run_command
from datagen.driving.scripted_driver import ScriptedDriver
from datagen.driving.trajectory import make_course
from mtlnet.calibration.drive import calibrate_film, calibrate_pictures
from mtlnet.calibration.lens import KnownLens, find_lens
from runtime.film import Mp4Writer
from simulator.camera import Camera, Light
from simulator.camera.core.optics import rotation
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World
from trackfeatures.camera import CameraParameters

CLAIM = {"pitch_deg": 0.3, "yaw_deg": 0.3, "height": 0.05}
REAL_DRIVE, REAL_CLAIM_DEG = "udacity_project_", 0.5
FPS = 10
SIZE = (640, 360)
TRACKS = ("countryside", "highway", "coast", "ring-road", "forest")
LIGHTS = ("clear", "overcast")
LANE_WIDTHS_M = (3.0, 4.2)
SPEEDS_KMH = (50.0, 75.0)


@dataclass(frozen=True)
class Mount:
    """Field of view and mount of a camera, and the drive that it films. Angles in degrees."""

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
    """Where the drive starts, as a share of the lap."""


def random_mount(seed: int) -> Mount:
    rng = np.random.default_rng([seed, 35])
    return Mount(
        pitch_deg=float(rng.uniform(-6.0, 6.0)),
        yaw_deg=float(rng.uniform(-4.0, 4.0)),
        roll_deg=float(rng.uniform(-2.0, 2.0)),
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
    """Write a film of `seconds` s of a drive of the scripted driver to `path`. The camera and the
    road are described by `mount`; `seed` determines the drive."""
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
        Mp4Writer(path, FPS) as film,
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


def _euler(turn: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return roll, pitch and yaw (rad) of a camera with the rotation matrix `turn` (3, 3): the
    inverse of `CameraParameters.rotation`."""
    return (
        float(np.arctan2(turn[2, 1], turn[2, 2])),
        float(-np.arcsin(turn[2, 0])),
        float(np.arctan2(turn[1, 0], turn[0, 0])),
    )


def errors(mount: Mount, path: Path) -> dict[str, float]:
    """Return the signed errors of the calibration of the film at `path` (calibrated minus true
    mount), and the standard deviations that the calibration estimates.

    Angles are in degrees; errors of the height are relative to the true height.
    """

    def lens(size: tuple[int, int]) -> KnownLens:
        return find_lens(size, CameraParameters(), fov_y_deg=mount.fov_y_deg)

    found = calibrate_film(path, lens, mount.lane_width_m).found
    camera, height = found.camera, found.camera.height_above_road_m
    return {
        "pitch_deg": camera.pitch_deg - mount.pitch_deg,
        "yaw_deg": camera.yaw_deg - mount.yaw_deg,
        "roll_deg": camera.roll_deg - mount.roll_deg,
        "height": height / mount.height_m - 1.0,
        "pitch_std_deg": found.pitch_std_deg,
        "yaw_std_deg": found.yaw_std_deg,
        "roll_std_deg": found.roll_std_deg,
        "height_std": found.height_std_m / height,
        "pictures": found.pictures,
    }


def real_pitch(folder: Path) -> dict[str, float] | None:
    """Return the pitch that is calibrated from the pictures of REAL_DRIVE, and the pitch that
    follows from the horizon in the labels of these pictures.

    The result is None if `folder` has no labels.csv.
    """
    if not (folder / "labels.csv").is_file():
        return None
    with (folder / "labels.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["file"].startswith(REAL_DRIVE)]
    fov_y_deg = float(rows[0]["fov_y_deg"])
    found = calibrate_pictures(
        [folder / row["file"] for row in rows],
        lambda size: find_lens(size, CameraParameters(), fov_y_deg=fov_y_deg),
    ).found
    middle = (found.camera.height - 1) / 2
    labelled = [
        math.degrees(math.atan((middle - float(row["horizon_y_px"])) / float(row["focal_px"])))
        for row in rows
    ]
    return {
        "pictures": len(rows),
        "used": found.pictures,
        "pitch_deg": found.camera.pitch_deg,
        "pitch_std_deg": found.pitch_std_deg,
        "labels_pitch_deg": float(np.mean(labelled)),
        "error_deg": found.camera.pitch_deg - float(np.mean(labelled)),
    }


def main(
    films: int = 10,
    seconds: float = 60.0,
    keep: Path | None = None,
    real: Path = Path("../shared/real_roads"),
    json: Path | None = None,
) -> None:
    found = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for seed in range(films):
            mount, path = random_mount(seed), folder / f"mount-{seed}.mp4"
            if not path.is_file():
                render_film(mount, path.with_suffix(".new.mp4"), seconds, seed)
                path.with_suffix(".new.mp4").rename(path)
            found.append({"mount": asdict(mount), "errors": errors(mount, path)})
            print(found[-1]["errors"], file=sys.stderr, flush=True)
    worst = {
        name: max(abs(film["errors"][name]) for film in found)
        for name in ("pitch_deg", "yaw_deg", "roll_deg", "height")
    }
    drive = real_pitch(real)
    reached = all(worst[name] <= most for name, most in CLAIM.items())
    reached &= drive is None or abs(drive["error_deg"]) <= REAL_CLAIM_DEG
    result = {"films": found, "worst": worst, "claim": CLAIM, "real": drive, "reached": reached}
    conclude(result, json, reached)


if __name__ == "__main__":
    run_command(main)
