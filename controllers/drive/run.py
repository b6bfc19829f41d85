"""Makes one drive from its configuration: road, world, perception, controller, observers.

controllers drive --controller lqr --track oval --perception truth --log drive.csv
"""

import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, Protocol

import numpy as np

import trackfeatures as tf
from controllers.drive.closed_loop import DriveLog, DriveResult, HeldThrottle, Pedals, run_lap
from controllers.drive.config import THROTTLE, DriveConfig
from controllers.drive.disturbance import Disturbance
from controllers.interface import LoopConfig
from controllers.laws.speed import on_perception, on_the_truth
from controllers.perception.late import LatePerception, TrustedPerception
from controllers.perception.perceived import Perceive, Perceived
from controllers.perception.real_time import RealTimePerception, real_time
from controllers.perception.sources import CameraPerception, open_perception
from controllers.registry import make_controller
from runtime.files import check_folder
from runtime.film import FILM_SUFFIX, Mp4Writer
from simulator.camera import check_light
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import CarState
from simulator.world.world import World
from trackfeatures import UserError
from trackfeatures.camera import CameraParameters

FREQUENCY_HZ = 20
SCORED_STEPS = {"forza": 6500, "alpine-2": 4500, "eroad": 3700, "g-track-3": 3300}
"""The paper's number of control steps of a drive on each of its four tracks."""
GRID_SHARE = 1.0 / 6.0
"""Distance of TORCS's first grid position to the right of the track's centre, as a share of the
track's width."""
TYPICAL_SPEED = 15.0  # m/s, slightly below the speed of gear 1 and THROTTLE on a flat road

START_M, START_S = 5.0, 10.0
"""A car did not start if it drove less than START_M (m) before its drive ended early, or less than
START_M in START_S (s)."""

Progress = Callable[[int, int], None]
"""A function that is called with the steps done and the total number of steps."""


@dataclass(frozen=True)
class Lane:
    """The start of a drive and the centre of the lane to follow, both in m left of the track's
    centre."""

    start_d: float
    centre: float


class Observer(Protocol):
    """A function that is called in each control step, before the car moves, with the true state,
    the perceived road and the steering action."""

    def __call__(self, now: CarState, perceived: Perceived, steer: float) -> None: ...


def drive(
    config: DriveConfig,
    progress: Progress | None = None,
    *,
    disturbance: Disturbance | None = None,
    observers: Sequence[Observer] = (),
    parameters: Mapping[str, float] | None = None,
) -> DriveResult:
    """Make the drive that `config` describes and return its result; `progress` and the `observers`
    are called in each step.

    `parameters`, if given, are used instead of the parameters in the file that `config` names. The
    log and the film are written step by step, so an interrupted drive leaves the driven part.
    Raises UserError for an unknown name, a lane or start outside the road, or a service that does
    not answer.
    """
    check_light(config.light)  # a misspelt name is an error even without a camera
    if config.video is not None:
        _check_film(config.video)
    track = find_track(config.track, config.tracks_dir)
    road = Road(track, lanes=config.lanes)
    lane = choose_lane(config, road)
    steps = steps_for(config.steps, track.name, track.length_m)
    disturbance = disturbance or Disturbance()
    loop = control_loop(config, disturbance)
    if parameters is None:
        parameters = read_parameters(config.parameters, config.controller)
    controller = make_controller(config.controller, loop, parameters)
    pedals = choose_pedals(config, road, lane)
    with ExitStack() as stack:
        world = stack.enter_context(
            disturbance.world(
                road, traffic=config.traffic, frequency_hz=FREQUENCY_HZ, seed=config.seed
            )
        )
        world.reset(seed=config.seed, to_middle=lane.start_d)
        scene: dict[str, Any] = {"light": config.light, "seed": config.seed}
        scene |= {"model": config.model, "views": config.views, "lane_centre": lane.centre}
        source = stack.enter_context(open_perception(config.perception, world, **scene))
        live = _real_time(config, source, disturbance) if config.realtime else None
        if live is not None:
            stack.enter_context(live)
        perceive = LastAnswer(live or delay(config, source, disturbance.delay_s))
        watching = [*observers, *_observers(config, stack, world, source, lane)]
        result = run_lap(
            world,
            disturbance.controller(controller, config.seed),
            perceive,
            steps,
            pedals=pedals,
            lane_centre=lane.centre,
            noisy=loop.noisy or disturbance.noise or bool(config.latency_ms or config.drop),
            record=_recorder(perceive, watching, steps, progress),
        )
        return result if live is None else replace(result, real_time=live.figures())


def control_loop(config: DriveConfig, disturbance: Disturbance) -> LoopConfig:
    """Return the properties of the control loop of a drive, for its controller.

    Answers to images are predicted to the present, so they have no delay for the controller. A
    disturbance can add a delay that the controller does not know.
    """
    noisy = config.perception != "truth"
    known = noisy and disturbance == Disturbance()
    return LoopConfig(1.0 / FREQUENCY_HZ, noisy=noisy, delay_s=0.0 if known else None)


def _check_film(path: Path) -> None:
    if path.suffix.lower() != FILM_SUFFIX:
        raise UserError(f"--video {path}: give a file ending in {FILM_SUFFIX}")
    check_folder(path)


def _real_time(
    config: DriveConfig, perceive: Perceive, disturbance: Disturbance
) -> RealTimePerception[World, Any, Any]:
    """Return a perception that calls `perceive` in real time. Raises UserError if `config` or
    `disturbance` also simulates a delay."""
    if config.latency_ms or disturbance.delay_s:
        raise UserError(
            "--realtime measures the delay of the answers; leave it out, or --latency-ms"
        )
    rng = np.random.default_rng([config.seed, 3])
    return real_time(perceive, dt=1.0 / FREQUENCY_HZ, drop=config.drop, rng=rng)


def check_started(config: DriveConfig, result: DriveResult) -> None:
    """Raise UserError if the car drove less than 5 m in a drive that lasted at least 10 s, or that
    an event (`result.ended`, for example a collision) ended, after any time."""
    seconds = result.steps / FREQUENCY_HZ
    if result.distance_m >= START_M or (result.ended is None and seconds < START_S):
        return
    what = f"ended with {result.ended}" if result.ended else "stood"
    raise UserError(
        f"the car did not start on {config.track}: it {what} after {seconds:g} s, "
        f"{result.distance_m:.1f} m driven; give another --throttle, --speed, --start-d or track"
    )


def choose_pedals(config: DriveConfig, road: Road, lane: Lane) -> Pedals:
    """Return pedals that hold the throttle or the speed of `config`.

    Raises UserError if both are given, and for a value out of range.
    """
    if config.speed is not None:
        if config.throttle is not None:
            raise UserError(
                f"--speed {config.speed:g} and --throttle {config.throttle:g} contradict each "
                "other; give one of them"
            )
        if config.perception == "truth":
            return on_the_truth(config.speed, road, lane.centre, 1.0 / FREQUENCY_HZ)
        return on_perception(config.speed, 1.0 / FREQUENCY_HZ)
    throttle = THROTTLE if config.throttle is None else config.throttle
    if not 0.0 <= throttle <= 1.0:
        raise UserError(f"throttle {throttle} is out of range; give one from 0 to 1")
    return HeldThrottle(throttle)


def delay(config: DriveConfig, perceive: Perceive, unknown_s: float = 0.0) -> Perceive:
    """Return `perceive` with the latency and the lost answers that `config` sets. Answers of a
    model with a large standard deviation get less weight.

    `unknown_s` (s) is an additional delay that the controller does not know: the state is predicted
    over the latency, but not over `unknown_s`.
    """
    late = partial(
        LatePerception,
        state=attrgetter("state"),
        dt=1.0 / FREQUENCY_HZ,
        rng=np.random.default_rng([config.seed, 3]),
    )
    if unknown_s > 0.0:
        perceive = late(perceive, latency_s=unknown_s, drop=0.0, predict=False)
    if config.latency_ms == 0.0 and config.drop == 0.0:
        if config.perception == "truth":
            return perceive
        return TrustedPerception(perceive, attrgetter("state"), dt=1.0 / FREQUENCY_HZ)
    return late(perceive, latency_s=config.latency_ms / 1000.0, drop=config.drop)


def read_parameters(path: Path | None, controller: str) -> dict[str, float]:
    """Read the parameters of `controller` in the file `path`, which `controllers tune` wrote;
    return {} if `path` is None.

    Raises UserError for another kind of file, or for a file without parameters of the controller.
    """
    if path is None:
        return {}
    try:
        found = json.loads(path.read_text())["controllers"][controller]["parameters"]
        return {str(name): float(value) for name, value in found.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path} has no parameters of {controller} ({error!r}); give a file that "
            "`controllers tune` wrote for it"
        ) from error


class LastAnswer:
    """Calls a perception and keeps its last answer, which the observers of the drive read."""

    def __init__(self, perceive: Perceive) -> None:
        self._perceive = perceive
        self.last: Perceived | None = None

    def __call__(self, world: World) -> Perceived:
        self.last = self._perceive(world)
        return self.last


def _observers(
    config: DriveConfig, stack: ExitStack, world: World, perceive: Perceive, lane: Lane
) -> Iterator[Observer]:
    """Yield the observers that `config` names: log, film and live page. `stack` closes them."""
    if config.video is not None:
        from controllers.drive.film import DriveFilm
        from simulator.camera import open_camera

        film = stack.enter_context(Mp4Writer(config.video, FREQUENCY_HZ))
        seen = perceive if isinstance(perceive, CameraPerception) else None
        if seen is not None:
            camera = seen.camera
        else:
            parameters = CameraParameters()
            camera = open_camera(world.road, parameters, light=config.light, seed=config.seed)
            stack.callback(camera.close)
        drawn = DriveFilm(film, world, camera, seen, lane_centre=lane.centre)
        yield lambda now, perceived, steer: drawn.add(perceived, steer)
    if config.watch is not None:
        from controllers.drive.watch import watch

        show = stack.enter_context(watch(config, world, lane.centre))
        yield lambda now, perceived, steer: show(perceived)
    if config.log is not None:  # last: an error above leaves the log of an earlier drive as it is
        log = DriveLog(stack.enter_context(config.log.open("w", encoding="utf-8")))
        yield lambda now, perceived, steer: log.write(now, steer)


def _recorder(
    perceive: LastAnswer, observers: list[Observer], steps: int, progress: Progress | None
) -> Callable[[CarState, float], None]:
    """Return a function that calls the `observers` and `progress`. `run_lap` calls this function in
    each of the `steps` control steps."""
    done = itertools.count()

    def record(state: CarState, steer: float) -> None:
        assert perceive.last is not None
        for observer in observers:
            observer(state, perceive.last, steer)
        if progress is not None:
            progress(next(done), steps)

    return record


def choose_lane(config: DriveConfig, road: Road) -> Lane:
    """Return the start of the drive and the lane to follow.

    Raises UserError for a lane or start outside the road. If a model perceives the road, it also
    raises UserError for a target lane other than the lane of the start, because an image shows only
    the offset from the lane that the car is in.
    """
    target = config.target_lane
    if target is not None and not 0 <= target < road.lanes:
        raise UserError(
            f"target lane {target} does not exist; the {road.lanes} lane(s) are numbered from 0, "
            "the leftmost"
        )
    if config.start_d is not None:
        start = config.start_d
    else:
        # The track's centre is between two lanes; `lane_index` then selects the right one.
        middle = tf.lane_index(0.0, road.lanes, road.lane_width)
        lane = middle if target is None else target
        start = tf.lane_centre(lane, road.lanes, road.lane_width)
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
    """Return the control steps of a drive: `requested`; if it is None, the paper's number for the
    track, or about one lap.

    Raises UserError for a number below 1.
    """
    if requested is not None:
        if requested < 1:
            raise UserError(f"{requested} steps requested; give 1 or more")
        return requested
    about = length_m / TYPICAL_SPEED * FREQUENCY_HZ
    return SCORED_STEPS.get(track, 100 * math.ceil(about / 100))
