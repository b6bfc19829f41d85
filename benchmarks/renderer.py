"""Measures images per second on one core: the camera alone, the image environment, and Gymnasium's
CarRacing-v3.

Run: `python benchmarks/renderer.py [--json FILE]`; it takes about three minutes. Claim, on one core
with Mesa's llvmpipe: at least 150 complete steps per second of `driverview/DriverView-v0` with an
image of 280 x 210 px, on every track, in clear light and in heavy shadow. The jobs take turns in
one process pinned to one core. The figures are medians over the turns, of processor time, or of
wall time if a GPU renders. Resets are not counted. `--quick` measures one turn.
"""

import os
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

# Mesa reads LP_NUM_THREADS when the first context is made; with 0 it draws in the calling thread.
os.environ.update(LP_NUM_THREADS="0", OMP_NUM_THREADS="1", SDL_VIDEODRIVER="dummy")

sys.path.insert(0, str(Path(__file__).parents[1]))

import gymnasium as gym
import numpy as np

import simulator.env  # noqa: F401  (registers the names)
from benchmarks.claims.outcome import conclude, run_command
from simulator.camera import Camera, Light
from simulator.camera.core.context import graphics
from simulator.camera.snapshot import standing_pose
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from trackfeatures.camera import CameraParameters

CLAIM_FRAMES_PER_SECOND = 150.0
TRACKS = ("circuit", "forest", "town", "mountain-pass")
LIGHTS = ("clear", "heavy-shadow")
SIZES = ((96, 96), (160, 120), (280, 210), (640, 480), (1280, 960))
KINDS = {
    "colour": ("front",),
    "depth": ("front:depth",),
    "class": ("front:class",),
    "colour, depth and class": ("front", "front:depth", "front:class"),
    "front, left, right and rear": ("front", "left", "right", "rear"),
}
CARS_AHEAD_M = (9.0, 16.0, 26.0, 38.0, 55.0, 80.0)
TURNS, FRAMES = 5, 60

Job = Callable[[int], float]
"""A function that draws the given number of frames and returns the time in s that this took."""


def clock() -> float:
    """Time in s: processor time of this process if the CPU renders, else wall time."""
    return time.process_time() if "llvmpipe" in graphics().renderer else time.perf_counter()


def camera_job(camera: Camera, views: tuple[str, ...] = ("front",), cars: int = 0) -> Job:
    """Return a Job that renders `views` from FRAMES positions along the road of `camera`.

    `cars` is the number of cars that stand ahead of each position.
    """
    road = camera.road
    places = np.linspace(0.0, road.track.length_m, FRAMES, endpoint=False)
    shots = [
        (
            standing_pose(road, s, 0.3),
            [standing_pose(road, s + gap, 0.0, height=0.0) for gap in CARS_AHEAD_M[:cars]],
        )
        for s in places
    ]

    def draw(frames: int) -> float:
        started = clock()
        for k in range(frames):
            pose, others = shots[k * len(shots) // frames]
            camera.render_views(pose, others or None, views)
        return clock() - started

    return draw


def environment_job(env: gym.Env[Any, Any]) -> Job:
    """Return a Job that steps an environment of this project. The steering is computed from the
    true state."""
    return _stepping(env, lambda info: _steering(info))


def car_racing_job() -> Job:
    """Return a Job that steps CarRacing-v3, which draws a picture of 96 x 96 px in each step."""
    return _stepping(
        gym.make("CarRacing-v3"), lambda info: np.array([0.0, 0.1, 0.0], dtype=np.float32)
    )


def _stepping(env: gym.Env[Any, Any], policy: Callable[[dict[str, Any]], Any]) -> Job:
    info = env.reset(seed=0)[1]

    def draw(frames: int) -> float:
        nonlocal info
        spent = 0.0
        for _ in range(frames):
            action = policy(info)
            started = clock()
            _, _, ended, cut, info = env.step(action)
            spent += clock() - started
            if ended or cut:
                info = env.reset()[1]
        return spent

    return draw


def _steering(info: dict[str, Any]) -> np.ndarray[Any, Any]:
    wheel = 2.0 * info["angle"] - 0.2 * info["to_middle"] if "angle" in info else 0.0
    return np.clip(np.array([wheel], dtype=np.float32), -1.0, 1.0)


def frames_per_second(jobs: dict[str, Job], turns: int) -> dict[str, float]:
    """Return the median over the `turns` of the frames per second of each job. The jobs take
    turns."""
    figures: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(turns + 1):
        for name, job in jobs.items():
            figure = FRAMES / job(FRAMES)
            if turn:  # turn 0 is the warm-up
                figures[name].append(figure)
        print(f"turn {turn} of {turns}, {len(jobs)} jobs", file=sys.stderr)
    return {name: round(statistics.median(values), 1) for name, values in figures.items()}


def camera(track: str, light: str, size: tuple[int, int] = (280, 210)) -> Camera:
    road = Road(find_track(track))
    kind = Light.named(light, np.random.default_rng([0, 2]))
    return Camera(road, CameraParameters(*size), seed=0, light=kind)


def environments(stack: ExitStack) -> Iterator[tuple[str, Job]]:
    for track in TRACKS:
        for light in LIGHTS:
            env = gym.make("driverview/DriverView-v0", track=track, light=light)
            stack.callback(env.close)
            yield f"{track}, {light}", environment_job(env)


def cameras(stack: ExitStack) -> Iterator[tuple[str, Job]]:
    for track in TRACKS:
        for light in LIGHTS:
            view = stack.enter_context(camera(track, light))
            for cars in (0, len(CARS_AHEAD_M)):
                yield f"{track}, {light}, {cars} cars", camera_job(view, cars=cars)


def sizes(stack: ExitStack) -> Iterator[tuple[str, Job]]:
    for size in SIZES:
        view = stack.enter_context(camera("circuit", "clear", size))
        yield f"{size[0]} x {size[1]}", camera_job(view)


def kinds(stack: ExitStack) -> Iterator[tuple[str, Job]]:
    view = stack.enter_context(camera("circuit", "clear"))
    for name, views in KINDS.items():
        yield name, camera_job(view, views)


def measure(turns: int) -> dict[str, dict[str, float]]:
    """Return the frames per second of all jobs, by group and job; each figure is a median over
    `turns`."""
    figures = {}
    for group in (environments, cameras, sizes, kinds):
        with ExitStack() as stack:
            jobs = dict(group(stack))
            if group is environments:
                jobs["CarRacing-v3, 96 x 96"] = car_racing_job()
            figures[group.__name__] = frames_per_second(jobs, turns)
    return figures


def main(quick: bool = False, json: Path | None = None) -> None:
    warnings.simplefilter("ignore")  # the peers print warnings
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    figures = measure(1 if quick else TURNS)
    peer = figures["environments"].pop("CarRacing-v3, 96 x 96")
    slowest = min(figures["environments"].values())
    reached = slowest >= CLAIM_FRAMES_PER_SECOND
    result = {
        "renderer": graphics().renderer,
        "frames_per_second": figures,
        "car_racing_frames_per_second": peer,
        "slowest_environment": slowest,
        "times_car_racing": round(slowest / peer, 2),
        "claim_frames_per_second": CLAIM_FRAMES_PER_SECOND,
        "reached": reached,
    }
    conclude(result, json, reached)


if __name__ == "__main__":
    run_command(main)
