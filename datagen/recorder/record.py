"""Recording one round: drive, look, measure, write. A pure function of the round's plan entry."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.driving.scripted_driver import ScriptedDriver
from datagen.driving.trajectory import make_course
from datagen.errors import RoundFailed
from datagen.planning.plan import RoundPlan, program
from datagen.recording.frame import DriverCommand, EgoState, Frame, RoadPlace, SensorReadings
from datagen.recording.mcap.writer import RoundWriter
from datagen.recording.round_metadata import RoundHeader
from simulator.camera import Camera, Light
from simulator.camera.overlay import marking_polylines
from simulator.sensors.sensor import SensorSuite
from simulator.sensors.standard import STANDARD
from simulator.track.catalogue import find_track
from simulator.track.geometry import Track
from simulator.track.road import Road
from simulator.vehicle.state import CarState, Command
from simulator.world.world import World

ANNOTATED_M = 60.0
SCENE_STEP_M = 4.0
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
NOT_RECORDED = ("range_traffic",)
MOST_RESETS = 20  # a control step of each frame: rounds of fewer frames a second drive for longer
# Steps are simulated, then drawn, then written, so many at a time: the driver needs no picture, and
# code that is run again at once is twice as fast as code that waits for a picture in between.
BATCH = 20
MOST_SCENES = BATCH  # kept ready by the camera, so that none is built twice for one batch
SCENERIES_APART = 2**40  # between the seeds of a round's sceneries: beyond the seed of any round


@dataclass
class RoundSimulation:
    """The state of a round while it is driven."""

    plan: RoundPlan
    world: World
    driver: ScriptedDriver
    driven_m: float = 0.0
    laps: int = 0
    resets: int = 0
    steps: int = 0
    speed_sum: float = 0.0
    state: CarState = field(init=False)
    sceneries: list[tuple[int, Light]] = field(init=False)

    def __post_init__(self) -> None:
        self.sceneries = [scenery(self.plan, k) for k in range(len(self.plan.lights))]
        start = self.plan.start * self.world.road.track.length_m
        self._start(start, self.driver.offset_at(0.0))

    def scenery_at(self, frame: int) -> tuple[int, Light]:
        """Seed and light of what stands round the car at a frame."""
        return self.sceneries[
            frame // (self.plan.stretch or self.plan.frames) % len(self.sceneries)
        ]

    def command(self) -> Command:
        return self.driver.command(self.state, self.world.traffic, self.driven_m)

    def step(self, command: Command) -> None:
        """One control step; a car that hits something or leaves the road is put back on it."""
        self.steps += 1
        self.speed_sum += max(self.state.speed, 0.0)
        lap = self.state.lap
        self.state = self.world.step(command)
        self.driven_m += max(self.state.speed, 0.0) / self.world.frequency_hz
        self.laps += self.state.lap - lap
        if self.state.collision or self.state.off_track or self.state.backwards:
            self.resets += 1
            if self.resets > MOST_RESETS * self.plan.steps_per_frame:
                raise RoundFailed(
                    f"the car hit something or left the road {self.resets} times on "
                    f"{self.plan.track}, {self.plan.lanes} lanes, {self.plan.speed_kmh:.0f} km/h"
                )
            self._start(self.state.s, 0.0)
            self.driver.restart()

    def _start(self, s: float, to_middle: float) -> None:
        self.state = self.world.reset(
            seed=self.plan.seed,  # never a neighbour's: it may stand on the split's other side
            s=s,
            to_middle=to_middle,
            speed=self.driver.speed_at(s),
        )


@dataclass(frozen=True, slots=True)
class FrameTruth:
    """A frame whose picture has not been taken yet."""

    scenery: tuple[int, Light]
    pose: NDArray[np.float64]
    traffic: NDArray[np.float64]
    features: tf.TrackFeatures
    place: RoadPlace
    ego: EgoState
    command: DriverCommand
    sensors: SensorReadings
    markings: tuple[NDArray[np.float64], ...]

    def picture(self, camera: Camera) -> NDArray[np.uint8]:
        """What the camera sees, (height, width, 3)."""
        camera.change_scene(*self.scenery)
        return camera.render(self.pose, self.traffic)

    def seen(self, image: NDArray[np.uint8]) -> Frame:
        return Frame(
            image=image,
            features=self.features,
            place=self.place,
            ego=self.ego,
            command=self.command,
            sensors=self.sensors,
            traffic=self.traffic,
            markings=self.markings,
        )


def record_round(
    plan: RoundPlan,
    plan_hash: str,
    path: Path,
    tracks_dir: Path | None,
    progress: Callable[[int], None] = lambda frames: None,
) -> None:
    """Drive the round and write it to `path`; `progress` hears how many frames are done."""
    with scene_of(plan, tracks_dir) as (drive, camera):
        header = _header(plan, plan_hash, drive.world.road)
        with RoundWriter(path, header, scene_lines(drive.world.road)) as writer:
            done = count(1)
            for moments in moments_of(drive, camera):
                images = [moment.picture(camera) for moment in moments]
                for moment, image in zip(moments, images, strict=True):
                    writer.add(moment.seen(image))
                    progress(next(done))
            writer.finish(
                laps=drive.laps,
                resets=drive.resets,
                distance_m=round(drive.driven_m, 3),
                mean_speed_kmh=round(3.6 * drive.speed_sum / drive.steps, 3),
            )


def moments_of(drive: RoundSimulation, camera: Camera) -> Iterator[list[FrameTruth]]:
    """All moments of a round from its beginning, some at a time."""
    suite = SensorSuite([s for s in STANDARD if s.name not in NOT_RECORDED])
    frames = drive.plan.frames
    for start in range(0, frames, BATCH):
        batch = range(start, min(start + BATCH, frames))
        yield [_next_moment(drive, camera, suite, drive.scenery_at(frame)) for frame in batch]


def scenery(plan: RoundPlan, number: int) -> tuple[int, Light]:
    """Seed and light of a round's scene, number 0 the first: no other round's."""
    rng = np.random.default_rng([plan.seed, 2, number])
    return plan.seed + number * SCENERIES_APART, Light.named(plan.lights[number], rng)


@lru_cache(maxsize=16)
def _track(name: str, tracks_dir: Path | None) -> Track:
    """Read once a process: a TORCS file takes a third of a second."""
    return find_track(name, tracks_dir)


@contextmanager
def scene_of(plan: RoundPlan, tracks_dir: Path | None) -> Iterator[tuple[RoundSimulation, Camera]]:
    """The world of a round with its driver at the start, and the camera that looks at it.

    Raises UserError when a track is not there or not the one of the plan, or nothing can draw.
    """
    track = _track(plan.track, tracks_dir)
    if track.content_hash != plan.track_hash:
        raise tf.UserError(
            f"track {plan.track} is not the one this dataset was planned with (its geometry has "
            "changed); collect into another folder"
        )
    road = Road(track, plan.lanes, plan.lane_width_m)
    speed = plan.speed_kmh / 3.6
    longest = plan.frames / plan.frequency_hz * speed * 1.1 + 50.0
    course = make_course(plan.trajectory, road, longest, np.random.default_rng([plan.seed, 3]))
    control_hz = plan.frequency_hz * plan.steps_per_frame
    seed, light = scenery(plan, 0)
    with (
        World(road, traffic=plan.traffic, frequency_hz=control_hz) as world,
        Camera(road, plan.camera, seed=seed, light=light, scenes=MOST_SCENES) as camera,
    ):
        driver = ScriptedDriver(road, course, speed, control_hz)
        yield RoundSimulation(plan, world, driver), camera


def _header(plan: RoundPlan, plan_hash: str, road: Road) -> RoundHeader:
    return RoundHeader(
        id=plan.id,
        seed=plan.seed,
        track=road.track.name,
        track_hash=plan.track_hash,
        lanes=plan.lanes,
        lane_width_m=plan.lane_width_m,
        traffic=plan.traffic,
        trajectory=plan.trajectory,
        lights=plan.lights,
        stretch=plan.stretch,
        speed_kmh=plan.speed_kmh,
        frequency_hz=plan.frequency_hz,
        codec=plan.codec,
        plan_hash=plan_hash,
        program=program(),
        camera=plan.camera,
        nominal_camera=None if plan.camera == plan.nominal_camera else plan.nominal_camera,
    )


def _next_moment(
    drive: RoundSimulation, camera: Camera, suite: SensorSuite, scene: tuple[int, Light]
) -> FrameTruth:
    """Everything true now and the command that is given; then the car goes on to the next."""
    camera.change_scene(*scene)
    world, now = drive.world, drive.state
    road, pose, command = world.road, world.body_pose(), drive.command()
    moment = FrameTruth(
        scenery=scene,
        pose=pose,
        traffic=world.traffic.poses(),
        features=world.features(),
        place=RoadPlace(
            lanes=road.lanes,
            lane_index=tf.lane_index(now.to_middle, road.lanes, road.lane_width),
            curvature=now.curvature,
            to_middle=now.to_middle,
            s=now.s,
        ),
        ego=EgoState(
            x=now.x,
            y=now.y,
            z=now.z,
            yaw=now.yaw,
            pitch=now.pitch,
            roll=now.roll,
            vx=now.vx,
            vy=now.vy,
            yaw_rate=now.yaw_rate,
            shadow_fraction=camera.shadow_fraction(pose),
        ),
        command=DriverCommand(command.steer, command.throttle, command.brake, command.gear),
        sensors=_readings(suite.read(world)),
        markings=tuple(marking_polylines(camera, road, (now.s, pose), ANNOTATED_M)),
    )
    drive.step(command)
    for _ in range(drive.plan.steps_per_frame - 1):
        drive.step(drive.command())
    return moment


def _readings(read: dict[str, Any]) -> SensorReadings:
    return SensorReadings(
        range=tuple(read["range"].tolist()),
        angle=read["angle"],
        speed=read["speed"],
        speed_x=read["v_x"],
        speed_y=read["v_y"],
        engine_rotation=read["engine"],
        odometer=read["odometer"],
        lap_time=read["lap_timer"],
        wheel_spin=tuple(read[f"wheel_spin_{wheel}"] for wheel in WHEELS),
    )


def scene_lines(road: Road) -> dict[str, NDArray[np.float64]]:
    """The markings and both edges of the asphalt all the way round, (N, 3) m each."""
    count = int(np.ceil(road.track.length_m / SCENE_STEP_M))
    s = np.linspace(0.0, road.track.length_m, count + 1)
    places = {f"marking {i}": y for i, y in enumerate(road.markings_y.tolist())}
    places |= {"left edge": road.half_asphalt, "right edge": -road.half_asphalt}
    lines = {}
    for name, y in places.items():
        pose = road.track.at(s, y)
        lines[name] = np.stack([pose.x, pose.y, pose.z], axis=1)
    return lines
