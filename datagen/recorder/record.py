"""Records one round: simulates the drive, renders the images and writes them with their labels. The
plan entry determines the recorded round completely."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from functools import lru_cache
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.driving.placement import Placement, draw_placements
from datagen.driving.scripted_driver import ScriptedDriver, SteeringLaw
from datagen.driving.trajectory import make_course
from datagen.errors import RoundFailed
from datagen.planning.plan import RoundPlan, program
from datagen.recording.frame import DriverCommand, EgoState, Frame, RoadPlace, SensorReadings
from datagen.recording.mcap.writer import RoundWriter
from datagen.recording.names import MIDDLE, PLACED
from datagen.recording.round_metadata import RoundHeader
from simulator.camera import Camera, Light
from simulator.camera.overlay import marking_polylines
from simulator.sensors.sensor import SensorSuite
from simulator.sensors.standard import STANDARD
from simulator.track.catalogue import find_track
from simulator.track.geometry import Track
from simulator.track.road import Road
from simulator.varied.look import RoadLook
from simulator.vehicle.state import CarState, Command
from simulator.world.world import World

MARKING_LENGTH_M = 60.0  # length of road ahead whose markings are recorded with an image
TRACK_LINE_STEP_M = 4.0
NO_IMAGE: NDArray[np.uint8] = np.zeros((0, 0, 3), np.uint8)
EGO_NAMES = ("x", "y", "z", "yaw", "pitch", "roll", "vx", "vy", "yaw_rate")
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
NOT_RECORDED = ("range_traffic",)
# Largest number of resets of a round with one control step per frame. The limit is proportional to
# the control steps per frame, because rounds at a low frame rate last longer.
MAX_RESETS = 20
# Frames are simulated, rendered and written in batches. This is possible because the driver needs
# no image, and simulation is twice as fast without rendering in between.
BATCH_FRAMES = 20
CACHED_SCENES = BATCH_FRAMES  # scenes that the camera keeps, so that a batch builds no scene twice
# Difference between the seeds of two consecutive scenes of a round. The seeds of the rounds of one
# plan differ by less, so scenes of different rounds of a plan never share a seed. Scenes of two
# plans can share one only if the seeds of the plans differ by more than a million.
SCENERY_SEED_STRIDE = 2**40


Scenery = tuple[int, Light, RoadLook | None]
"""Arguments of `Camera.change_scene`: seed, light, and look of the road (None: the paper's)."""

MakeLaw = Callable[[RoundPlan, World, Camera], SteeringLaw]
"""Makes the steering law that replaces the scripted driver's in a round, from the plan entry, the
world and the camera on the car. The camera shows the scenery of the current frame."""


@dataclass
class RoundSimulation:
    """State of a round during its simulation."""

    plan: RoundPlan
    world: World
    driver: ScriptedDriver
    placements: list[Placement] = field(default_factory=list)
    """The pose of the car in each frame of a round of the trajectory PLACED; otherwise empty."""
    frame: int = 0
    driven_m: float = 0.0
    laps: int = 0
    resets: int = 0
    steps: int = 0
    speed_sum: float = 0.0
    state: CarState = field(init=False)
    sceneries: list[Scenery] = field(init=False)

    def __post_init__(self) -> None:
        self.sceneries = [scenery(self.plan, k) for k in range(len(self.plan.lights))]
        if self.placements:
            self._place(self.placements[0])
        else:
            start = self.plan.start * self.world.road.track.length_m
            self._start(start, self.driver.offset_at(0.0))

    def scenery_at(self, frame: int) -> Scenery:
        """Return the scenery (seed, light and look of the road) of frame `frame` (from 0) of the
        round."""
        return self.sceneries[
            frame // (self.plan.stretch or self.plan.frames) % len(self.sceneries)
        ]

    def command(self) -> Command:
        """Return the driver's command for the next control step."""
        return self.driver.command(self.state, self.world.traffic, self.driven_m)

    def advance(self, command: Command) -> None:
        """Advance to the next frame. `command` is the driver's command for the current state, the
        result of `command()`. A round of the trajectory PLACED ends in its last frame."""
        self.frame += 1
        if self.placements:
            if self.frame < len(self.placements):
                self._place(self.placements[self.frame])
            return
        self.step(command)
        for _ in range(self.plan.steps_per_frame - 1):
            self.step(self.command())

    def step(self, command: Command) -> None:
        """Do one control step. If the car then has collided, is off the road or drives backwards,
        it is reset to the middle of the road.

        Raises RoundFailed after more than 20 resets (MAX_RESETS) times the control steps per frame.
        """
        self.steps += 1
        self.speed_sum += max(self.state.speed, 0.0)
        lap = self.state.lap
        self.state = self.world.step(command)
        self.driven_m += max(self.state.speed, 0.0) / self.world.frequency_hz
        self.laps += self.state.lap - lap
        if self.state.collision or self.state.off_track or self.state.backwards:
            self.resets += 1
            if self.resets > MAX_RESETS * self.plan.steps_per_frame:
                raise RoundFailed(
                    f"the car hit something or left the road {self.resets} times on "
                    f"{self.plan.track}, {self.plan.lanes} lanes, {self.plan.speed_kmh:.0f} km/h"
                )
            self._start(self.state.s, 0.0)
            self.driver.restart()

    def _place(self, pose: Placement) -> None:
        """Put the car at rest at `pose`, among other traffic than in the frame before."""
        self.state = self.world.reset(
            seed=self.plan.seed + self.frame * SCENERY_SEED_STRIDE,
            s=pose.s,
            to_middle=pose.to_middle,
            angle=pose.angle,
        )
        self.driver.restart()

    def _start(self, s: float, to_middle: float) -> None:
        self.state = self.world.reset(
            seed=self.plan.seed,  # not a seed of another round, which may be on another side
            s=s,
            to_middle=to_middle,
            speed=self.driver.speed_at(s),
        )


@dataclass(frozen=True, slots=True)
class FrameTruth:
    """Everything that is recorded of a frame except its image, which `render` makes."""

    scenery: Scenery
    pose: NDArray[np.float64]
    frame: Frame
    """The frame with an empty image."""

    def render(self, camera: Camera) -> NDArray[np.uint8]:
        """Render the image of the frame, (height, width, 3) uint8 RGB."""
        camera.change_scene(*self.scenery)
        near_s, view = self.frame.place.s, ("front",)
        found: NDArray[np.uint8] = camera.render_views(
            self.pose, self.frame.traffic, view, near_s=near_s
        )["front"]
        return found


def record_round(
    plan: RoundPlan,
    plan_hash: str,
    path: Path,
    tracks_dir: Path | None,
    progress: Callable[[int], None] = lambda frames: None,
    make_law: MakeLaw | None = None,
) -> None:
    """Record the round to `path`; `progress` is called with the number of frames written so far.

    `plan_hash` is stored in the file. `tracks_dir` is a further folder to search for the track.
    `make_law` creates a steering law in place of the scripted driver's.
    """
    with open_simulation(plan, tracks_dir, make_law) as (simulation, camera):
        road = simulation.world.road
        header = _header(plan, plan_hash, road)
        with RoundWriter(path, header, track_lines(road)) as writer:
            done = count(1)
            for batch in simulate(simulation, camera):
                images = [truth.render(camera) for truth in batch]
                for truth, image in zip(batch, images, strict=True):
                    writer.add(replace(truth.frame, image=image))
                    progress(next(done))
            writer.finish(
                laps=simulation.laps,
                resets=simulation.resets,
                distance_m=round(simulation.driven_m, 3),
                mean_speed_kmh=round(3.6 * simulation.speed_sum / max(simulation.steps, 1), 3),
            )


def simulate(simulation: RoundSimulation, camera: Camera) -> Iterator[list[FrameTruth]]:
    """Simulate a round; yield its frames, without images, in lists of 20 (BATCH_FRAMES); the last
    list can be shorter."""
    suite = SensorSuite([s for s in STANDARD if s.name not in NOT_RECORDED])
    frames = simulation.plan.frames
    for start in range(0, frames, BATCH_FRAMES):
        batch = range(start, min(start + BATCH_FRAMES, frames))
        yield [_next_frame(simulation, camera, suite, frame) for frame in batch]


def scenery(plan: RoundPlan, number: int) -> Scenery:
    """Return the seed, the light and the look of the road of scene `number` (from 0) of a round.
    The look is None on the paper's roads. Each scene has its own seed."""
    light = Light.named(plan.lights[number], np.random.default_rng([plan.seed, 2, number]))
    look = plan.varied.scenes[number] if plan.varied else None
    return plan.seed + number * SCENERY_SEED_STRIDE, light, look


@lru_cache(maxsize=16)
def _track(name: str, tracks_dir: Path | None) -> Track:
    """Read a track once per process: a TORCS file takes a third of a second."""
    return find_track(name, tracks_dir)


@contextmanager
def open_simulation(
    plan: RoundPlan, tracks_dir: Path | None, make_law: MakeLaw | None = None
) -> Iterator[tuple[RoundSimulation, Camera]]:
    """Yield the simulation of a round, at the round's start, and the camera on its car.

    `make_law` creates a steering law in place of the scripted driver's. Raises UserError if the
    track is missing or changed, or if the machine cannot render.
    """
    track = _track(plan.track, tracks_dir)
    if track.content_hash != plan.track_hash or plan.picture_hash not in ("", track.picture_hash):
        raise tf.UserError(
            f"track {plan.track} is not the one this dataset was planned with (its geometry, "
            "surface, scenery or paint has changed); collect into another folder"
        )
    carriageway = plan.varied.carriageway if plan.varied else None
    road = Road(track, plan.lanes, plan.lane_width_m, carriageway)
    speed = plan.speed_kmh / 3.6
    longest = plan.frames / plan.frequency_hz * speed * 1.1 + 50.0
    rng, placed = np.random.default_rng([plan.seed, 3]), plan.trajectory == PLACED
    course = make_course(MIDDLE if placed else plan.trajectory, road, longest, rng)
    placements = draw_placements(road, plan.frames, rng) if placed else []
    control_hz = plan.frequency_hz * plan.steps_per_frame
    seed, light, look = scenery(plan, 0)
    with (
        World(road, traffic=plan.traffic, frequency_hz=control_hz) as world,
        Camera(
            road, plan.camera, seed=seed, light=light, look=look, scenes=CACHED_SCENES
        ) as camera,
    ):
        law = None if make_law is None else make_law(plan, world, camera)
        driver = ScriptedDriver(road, course, speed, control_hz, law=law)
        yield RoundSimulation(plan, world, driver, placements), camera


def _header(plan: RoundPlan, plan_hash: str, road: Road) -> RoundHeader:
    names = [each.name for each in fields(RoundHeader)]
    planned = {name: getattr(plan, name) for name in names if hasattr(plan, name)}
    planned |= {
        "track": road.track.name,
        "nominal_camera": None if plan.camera == plan.nominal_camera else plan.nominal_camera,
        "varied": asdict(plan.varied) if plan.varied else None,
    }
    return RoundHeader(**planned, plan_hash=plan_hash, program=program())


def _next_frame(
    simulation: RoundSimulation, camera: Camera, suite: SensorSuite, number: int
) -> FrameTruth:
    """Return frame `number` without its image, and advance the simulation to the next frame.
    `suite` reads the sensors."""
    scene = simulation.scenery_at(number)
    camera.change_scene(*scene)
    world, now = simulation.world, simulation.state
    road, pose, command = world.road, world.body_pose(), simulation.command()
    frame = Frame(
        image=NO_IMAGE,
        features=world.features(),
        place=RoadPlace(
            lanes=road.lanes,
            lane_index=tf.lane_index(now.to_middle, road.lanes, road.lane_width),
            curvature=now.curvature,
            to_middle=now.to_middle,
            s=now.s,
        ),
        ego=EgoState(
            **{name: getattr(now, name) for name in EGO_NAMES},
            shadow_fraction=camera.shadow_fraction(pose, now.s),
        ),
        command=DriverCommand(command.steer, command.throttle, command.brake, command.gear),
        sensors=_readings(suite.read(world)),
        traffic=world.traffic.poses(),
        markings=tuple(marking_polylines(camera, road, (now.s, pose), MARKING_LENGTH_M)),
    )
    simulation.advance(command)
    return FrameTruth(scene, pose, frame)


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


def track_lines(road: Road) -> dict[str, NDArray[np.float64]]:
    """Return the markings and both edges of the asphalt along the whole lap, by name; each is (N,
    3) in m in the world frame."""
    count = int(np.ceil(road.track.length_m / TRACK_LINE_STEP_M))
    s = np.linspace(0.0, road.track.length_m, count + 1)
    places = {f"marking {i}": y for i, y in enumerate(road.markings_y.tolist())}
    places |= {"left edge": road.asphalt[0], "right edge": -road.asphalt[1]}
    lines = {}
    for name, y in places.items():
        pose = road.track.at(s, y)
        lines[name] = np.stack([pose.x, pose.y, pose.z], axis=1)
    return lines
