"""One drive from its configuration: road, world, perception, controller, log.

controllers drive --controller lqr --track oval --perception truth --log drive.csv
"""

import itertools
import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass

import trackfeatures as tf
from controllers.closed_loop import DriveLog, DriveResult, run_lap
from controllers.config import DriveConfig
from controllers.perception import PerceptionSource, open_perception
from controllers.registry import LoopConfig, make_controller
from simulator.camera import check_light
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import CarState
from simulator.world.world import World
from trackfeatures import UserError

FREQUENCY_HZ = 20
SCORED_STEPS = {"forza": 6500, "alpine-2": 4500, "eroad": 3700, "g-track-3": 3300}
"""Numbers of steps by track at which scores are compared with the paper's."""
TYPICAL_SPEED = 15.0  # m/s, a little less than gear 1 and the default throttle give on a flat road

Progress = Callable[[int, int], None]
"""Called with the steps done and the steps in all."""


@dataclass(frozen=True)
class Lane:
    """Where a drive starts and the line it follows, m left of the track's centre."""

    start_d: float
    centre: float


def drive(config: DriveConfig, progress: Progress | None = None) -> DriveResult:
    """Drive as `config` says; `progress` is called each step.

    The log is written row by row, so an interrupted drive leaves the rows driven. Raises UserError
    for an unknown name, a lane or start outside the road, or a service that does not answer.
    """
    check_light(config.light)  # also without a camera: a misspelt name is an error in any case
    track = find_track(config.track, config.tracks_dir)
    road = Road(track, lanes=config.lanes)
    lane = choose_lane(config, road)
    steps = steps_for(config.steps, track.name, track.length_m)
    noisy = config.perception != "truth"
    controller = make_controller(config.controller, LoopConfig(1.0 / FREQUENCY_HZ, noisy=noisy))
    if not 0.0 <= config.throttle <= 1.0:
        raise UserError(f"throttle {config.throttle} is out of range; give one from 0 to 1")
    with ExitStack() as stack:
        world = stack.enter_context(World(road, traffic=config.traffic, frequency_hz=FREQUENCY_HZ))
        world.reset(seed=config.seed, to_middle=lane.start_d)
        source = stack.enter_context(_open_perception(config, world, lane))
        return run_lap(
            world,
            controller,
            source.perceive,
            steps,
            throttle=config.throttle,
            lane_centre=lane.centre,
            noisy=noisy,
            record=_recorder(config, stack, steps, progress),
        )


def _open_perception(config: DriveConfig, world: World, lane: Lane) -> PerceptionSource:
    return open_perception(
        config.perception,
        world,
        model=config.model,
        lane_centre=lane.centre,
        light=config.light,
        seed=config.seed,
    )


def _recorder(
    config: DriveConfig, stack: ExitStack, steps: int, progress: Progress | None
) -> Callable[[CarState, float], None]:
    """Writes the log, which `stack` closes, and reports progress."""
    log = None
    if config.log is not None:
        log = DriveLog(stack.enter_context(config.log.open("w", encoding="utf-8")))
    done = itertools.count()

    def record(state: CarState, steer: float) -> None:
        if log is not None:
            log.write(state, steer)
        if progress is not None:
            progress(next(done), steps)

    return record


def choose_lane(config: DriveConfig, road: Road) -> Lane:
    """The lane to follow and where to start.

    Raises UserError for a lane or start outside the road and, on perception, for a target other
    than the lane of the start: an image shows the offset only from the lane the car is in.
    """
    target = config.target_lane
    if target is not None and not 0 <= target < road.lanes:
        raise UserError(
            f"target lane {target} does not exist; the {road.lanes} lane(s) are numbered from 0, "
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
            f"the start is in lane {nearest}, the target is lane {target}: perception measures "
            "only the lane the car is in; leave --start-d out, or use --perception truth"
        )
    chosen = nearest if target is None else target
    return Lane(start, tf.lane_centre(chosen, road.lanes, road.lane_width))


def steps_for(requested: int | None, track: str, length_m: float) -> int:
    """The steps requested; else the track's scored number; else about one lap, in hundreds."""
    if requested is not None:
        if requested < 1:
            raise UserError(f"{requested} steps requested; give 1 or more")
        return requested
    about = length_m / TYPICAL_SPEED * FREQUENCY_HZ
    return SCORED_STEPS.get(track, 100 * math.ceil(about / 100))
