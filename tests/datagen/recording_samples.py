"""Rounds made without a simulator: smooth images and random but consistent labels."""

from pathlib import Path

import numpy as np

import trackfeatures as tf
from datagen.recording.camera import CameraInfo
from datagen.recording.frame import DriverCommand, EgoState, Frame, RoadPlace, SensorReadings
from datagen.recording.header import RoundHeader, RoundResult
from datagen.recording.writer import RoundWriter

LANES = 2
CAMERA = CameraInfo(width=56, height=42)


def header(round_id: str = "r000", seed: int = 1, **changes: object) -> RoundHeader:
    values: dict[str, object] = {
        "id": round_id,
        "seed": seed,
        "track": "a-track",
        "track_hash": "0" * 64,
        "lanes": LANES,
        "lane_width_m": 4.0,
        "traffic": 2,
        "trajectory": "weave",
        "light": "clear",
        "speed_kmh": 60.0,
        "camera": CAMERA,
    }
    return RoundHeader(**{**values, **changes})  # type: ignore[arg-type]  # a test's short cut


def frames(count: int, seed: int, camera: CameraInfo = CAMERA) -> list[Frame]:
    rng = np.random.default_rng(seed)
    return [_frame(rng, camera) for _ in range(count)]


def write_round(path: Path, about: RoundHeader, made: list[Frame]) -> RoundResult:
    scene = {"left": np.arange(30.0).reshape(10, 3)}
    with RoundWriter(path, about, scene) as writer:
        for frame in made:
            writer.add(frame)
        return writer.finish(laps=1, distance_m=12.5, mean_speed_kmh=60.0)


def _frame(rng: np.random.Generator, camera: CameraInfo) -> Frame:
    to_middle, angle = rng.uniform(-7.0, 7.0), rng.normal(0.0, 0.05)
    curvature, ahead = rng.normal(0.0, 0.01, 2)
    rows, columns = np.mgrid[: camera.height, : camera.width]
    ramp = (rows * rng.uniform(1, 3) + columns * rng.uniform(1, 2)) % 256
    image = np.stack([ramp, ramp // 2, 255 - ramp], axis=-1).astype(np.uint8)
    return Frame(
        image=image,
        features=tf.measure(to_middle, angle, curvature, ahead, LANES, 4.0),
        place=RoadPlace(LANES, tf.lane_index(to_middle, LANES, 4.0), curvature, to_middle, 7.0),
        ego=EgoState(1.0, 2.0, 0.3, angle, 0.01, -0.02, 15.0, 0.1, 0.05, 0.25),
        command=DriverCommand(0.1, 0.2, 0.0, 3),
        sensors=SensorReadings(range=tuple(rng.uniform(0, 200, 19)), wheel_spin=(1, 2, 3, 4)),
        traffic=rng.uniform(-5, 5, (2, 6)),
        markings=(rng.uniform(0, 40, (12, 2)), rng.uniform(0, 40, (8, 2))),
    )
