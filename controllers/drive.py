"""One drive from its configuration: road, world, eyes, controller, log.

controllers drive --controller lqr --track oval --perception truth --log drive.csv
"""

import itertools
import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import trackfeatures as tf
from controllers.closed_loop import THROTTLE, DriveLog, DriveResult, run_lap
from controllers.perception import open_perception
from controllers.registry import Setting, make_controller
from simulator.camera import check_light
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import CarState
from simulator.world.world import World
from trackfeatures import UserError

FREQUENCY_HZ = 20
SCORED_STEPS = {"forza": 6500, "alpine-2": 4500, "eroad": 3700, "g-track-3": 3300}
"""The fixed numbers of steps that scores are compared over."""
USUAL_SPEED = 15.0  # m/s, a little less than gear 1 and the default throttle give on a flat road


@dataclass(frozen=True)
class DriveConfig:
    """One closed-loop drive. The same configuration gives the same drive."""

    controller: str = "lqr"
    track: str = "oval"
    lanes: int = 1
    perception: str = "truth"
    """truth, model, or the address of a service."""
    steps: int | None = None
    """Control steps of 50 ms; None: the track's scored number, else about one lap."""
    log: Path | None = None
    model: str = "default"
    """The run that perception `model` drives with; default: the shipped one, else the latest."""
    start_d: float | None = None
    """m left of the track's centre; None: the middle of the target lane, or 0 without one."""
    target_lane: int | None = None
    """0 is the leftmost; None: the lane nearest to the start."""
    throttle: float = THROTTLE
    traffic: int = 0
    light: str = "clear"
    seed: int = 0
    tracks_dir: Path | None = None


@dataclass(frozen=True)
class Lane:
    """Where a drive starts and the line it follows, m left of the track's centre."""

    start_d: float
    centre: float


def drive(config: DriveConfig, progress: Callable[[int, int], None] | None = None) -> DriveResult:
    """Drives `config`; each step calls `progress` with the steps done and those to do.

    The log is written row by row, so what was driven is kept whatever happens. Raises UserError
    for what cannot be: an unknown name, a lane or place that is not there, a service that is down.
    """
    check_light(config.light)  # the truth needs none, but a misspelt one is a mistake all the same
    track = find_track(config.track, config.tracks_dir)
    road = Road(track, lanes=config.lanes)
    lane = choose_lane(config, road)
    steps = steps_for(config.steps, track.name, track.length_m)
    setting = Setting(1.0 / FREQUENCY_HZ, perceived=config.perception != "truth")
    controller = make_controller(config.controller, setting)
    if not 0.0 <= config.throttle <= 1.0:
        raise UserError(f"throttle {config.throttle} is out of range; give one from 0 to 1")
    with ExitStack() as stack:
        world = stack.enter_context(World(road, traffic=config.traffic, frequency_hz=FREQUENCY_HZ))
        world.reset(seed=config.seed, to_middle=lane.start_d)
        eyes = stack.enter_context(
            open_perception(
                config.perception,
                world,
                model=config.model,
                lane_centre=lane.centre,
                light=config.light,
                seed=config.seed,
            )
        )
        log = None
        if config.log is not None:
            log = DriveLog(stack.enter_context(config.log.open("w", encoding="utf-8")))
        done = itertools.count()

        def record(state: CarState, steer: float) -> None:
            if log is not None:
                log.write(state, steer)
            if progress is not None:
                progress(next(done), steps)

        return run_lap(
            world,
            controller,
            eyes.perceive,
            steps,
            throttle=config.throttle,
            lane_centre=lane.centre,
            record=record,
        )


def choose_lane(config: DriveConfig, road: Road) -> Lane:
    """The lane to follow and where to start.

    Raises UserError for a lane that is not there, and on perception for a target other than the
    lane the drive starts in: an image tells only the offset from the lane the car is in.
    """
    target = config.target_lane
    if target is not None and not 0 <= target < road.lanes:
        raise UserError(
            f"target lane {target} is not there; the {road.lanes} lane(s) are numbered from 0, "
            "the leftmost"
        )
    if config.start_d is not None:
        start = config.start_d
    elif target is not None:
        start = tf.lane_centre(target, road.lanes, road.lane_width)
    else:
        start = 0.0
    if not (math.isfinite(start) and abs(start) <= road.edge):
        raise UserError(
            f"start-d {start:g} m is off the road, which ends {road.edge:.2f} m from its centre"
        )
    nearest = tf.lane_index(start, road.lanes, road.lane_width)
    if target is not None and target != nearest and config.perception != "truth":
        raise UserError(
            f"the start is in lane {nearest}, the target is lane {target}: perception tells only "
            "the lane the car is in; leave --start-d out, or drive on the truth"
        )
    chosen = nearest if target is None else target
    return Lane(start, tf.lane_centre(chosen, road.lanes, road.lane_width))


def steps_for(asked: int | None, track: str, length_m: float) -> int:
    """The steps asked for; else the track's scored number; else about one lap, in hundreds."""
    if asked is not None:
        if asked < 1:
            raise UserError(f"{asked} steps asked for; give 1 or more")
        return asked
    about = length_m / USUAL_SPEED * FREQUENCY_HZ
    return SCORED_STEPS.get(track, 100 * math.ceil(about / 100))
