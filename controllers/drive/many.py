"""Drives many cars with one controller at the same time; compiled code moves and observes the cars.

The result of a drive equals the result of `controllers.drive.run.drive` bit for bit, for any number
of drives. All drives have exact states and a constant throttle; each core moves a part of the cars.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from threading import Event
from typing import Any, cast

import numpy as np

from controllers.drive.closed_loop import GEAR, Driven, DriveResult
from controllers.drive.config import THROTTLE, DriveConfig
from controllers.drive.disturbance import NOISE_STD, Disturbance
from controllers.drive.many_step import (
    LOG,
    LOG_ANGLE,
    LOG_OFFSET,
    LOG_STEER,
    RideArrays,
    command_rides,
    observe_rides,
)
from controllers.drive.run import FREQUENCY_HZ, Lane, choose_lane, read_parameters, steps_for
from controllers.interface import OBSERVED, BatchController, LoopConfig, Observations
from controllers.perception.late import delay_steps
from controllers.registry import make_controller
from simulator.arrays import FloatArray
from simulator.bounds import clip_rounding
from simulator.env.reward import ENDINGS
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.dynamics import ODOMETER
from simulator.world.control_rate import PHYSICS_HZ
from simulator.world.control_step import advance_cars
from simulator.world.fleet import COMMAND_AT, DONE, LAP, MEMORY_AT, SKIPPED, STEPS, Fleet
from simulator.world.world import World
from trackfeatures.errors import UserError

CARS = 64
"""Largest number of cars in one batch: with 64 cars the Python code takes a small part of the time
of a step."""
FREE = (
    *("controller", "parameters", "track", "tracks_dir", "lanes", "steps", "start_d"),
    *("target_lane", "seed", "model", "views", "light"),
)
"""Options of a drive with exact states that may differ from their defaults. The model, its views
and the light are allowed, because they have no effect on exact states."""
STEPS_BETWEEN_REPORTS = 50
LOOP = LoopConfig(1.0 / FREQUENCY_HZ)
PHYSICS_STEPS = PHYSICS_HZ // FREQUENCY_HZ

Task = tuple[DriveConfig, Disturbance]
Report = Callable[[float], None]
"""A function that is called with the number of drives done (parts of a drive count as fractions).
Several threads call it."""


@dataclass(frozen=True)
class Outcome:
    """The result of one drive of `drive_many`."""

    number: int
    """Index of the drive in the list of drives."""
    result: DriveResult | UserError
    """The result, or the error of a drive without a result; an error does not stop other drives."""
    curves: FloatArray
    """(n, 5), a row for each control step: time (s), true offset (m) and angle (rad), and the
    perceived offset and angle on which the controller acted. NaN: nothing was perceived."""


@dataclass(frozen=True)
class _Ride:
    """A drive whose configuration has been checked."""

    number: int
    road: Road
    lane: Lane
    steps: int
    seed: int
    disturbance: Disturbance


def can_join(config: DriveConfig) -> bool:
    """Whether `drive_many` can make a drive if its controller has `update_batch`.

    All options of `config` except the options in FREE must have their default values. So the drive
    has exact states and no traffic, simulated latency, film, log or set speed.
    """
    return config == replace(DriveConfig(), **{name: getattr(config, name) for name in FREE})


def drive_many(
    tasks: Sequence[Task],
    parameters: Mapping[str, float] | None = None,
    report: Report | None = None,
) -> Iterator[list[Outcome]]:
    """Make the drives `tasks`, which all have the same controller; yield their outcomes in batches.

    `parameters`, if given, are used instead of the parameters in the file that a configuration
    names. `report` is called with the number of drives done. Raises UserError for an unknown name,
    for a start outside the road, and if `update_batch` of the controller raises an error.
    """
    rides = _check(tasks)
    config = tasks[0][0]
    if parameters is None:
        parameters = read_parameters(config.parameters, config.controller)
    cores = len(os.sched_getaffinity(0))
    size = min(CARS, -(-len(rides) // cores))
    rides.sort(key=lambda ride: -ride.steps)  # a batch takes as long as its longest drive
    batches = [rides[begin : begin + size] for begin in range(0, len(rides), size)]
    done = [0.0] * len(batches)
    stop = Event()

    def drive(place: int, controller: BatchController) -> list[Outcome]:
        with _Batch(batches[place], controller) as batch:
            for share in batch.drive():
                if stop.is_set():
                    return []
                done[place] = share * len(batches[place])
                if report is not None:
                    report(sum(done))
            return batch.outcomes()

    with ThreadPoolExecutor(cores) as pool:
        waiting: list[Future[list[Outcome]]] = []
        try:
            for place in range(len(batches)):
                made = make_controller(config.controller, LOOP, parameters)
                waiting.append(pool.submit(drive, place, cast(BatchController, made)))
            for batch in as_completed(waiting.copy()):
                waiting.remove(batch)  # it would keep the outcomes in memory
                yield batch.result()
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


def _check(tasks: Sequence[Task]) -> list[_Ride]:
    """Check the tasks and return their rides; rides on the same road share one `Road`."""
    roads: dict[Any, Road] = {}
    rides = []
    for number, (config, disturbance) in enumerate(tasks):
        place = (config.track, config.tracks_dir, config.lanes)
        if place not in roads:
            track = find_track(config.track, config.tracks_dir)
            roads[place] = Road(track, lanes=config.lanes)
        road = roads[place]
        steps = steps_for(config.steps, road.track.name, road.track.length_m)
        lane = choose_lane(config, road)
        rides.append(_Ride(number, road, lane, steps, config.seed, disturbance))
    return rides


class _Batch:
    """The cars of several rides, steered by one controller object."""

    def __init__(self, rides: list[_Ride], controller: BatchController) -> None:
        self._rides, self._controller = rides, controller
        self._fleet = Fleet(len(rides))
        self._errors: dict[int, UserError] = {}
        cars = [ride.disturbance.car(ride.seed) for ride in rides]
        self._worlds = [
            World(ride.road, frequency_hz=FREQUENCY_HZ, car=car, fleet=self._fleet, number=number)
            for number, (ride, car) in enumerate(zip(rides, cars, strict=True))
        ]
        self._arrays = _arrays(rides, [car.total_mass for car in cars])

    def drive(self) -> Iterator[float]:
        """Drive all cars to the ends of their drives. Yields the share of the work done, 0 to 1,
        from time to time."""
        for ride, world in zip(self._rides, self._worlds, strict=True):
            world.reset(seed=ride.seed, to_middle=ride.lane.start_d)
        rows, count = self._fleet.cars, len(self._rides)
        rows[:, COMMAND_AT + 1 : COMMAND_AT + 4] = THROTTLE, 0.0, GEAR
        rows[:, DONE] = PHYSICS_STEPS  # so that `observe_rides` observes the start, too
        observe_rides(0, count, self._fleet.arrays, self._arrays, PHYSICS_STEPS)
        observations, longest = Observations(self._arrays.seen), max(self._arrays.steps.tolist())
        for step in range(longest):
            steers = self._check_steers(self._controller.update_batch(observations), step)
            fleet = self._fleet.arrays
            command_rides(fleet, self._arrays, steers, FREQUENCY_HZ)
            advance_cars(0, count, fleet, PHYSICS_STEPS)
            running, incomplete = observe_rides(0, count, fleet, self._arrays, PHYSICS_STEPS)
            if incomplete:
                running += self._complete()
            if not running:
                break
            if step % STEPS_BETWEEN_REPORTS == 0:
                yield step / longest
        yield 1.0

    def outcomes(self) -> list[Outcome]:
        return [self._outcome(number) for number in range(len(self._rides))]

    def _check_steers(self, steers: FloatArray, step: int) -> FloatArray:
        """Return `steers` (N,). A drive whose action is not in [-1, 1] ends here, with an error
        instead of a result."""
        rows = self._fleet.cars
        wrong = ~(np.abs(steers) <= 1.0) & (rows[:, SKIPPED] == 0.0)
        for number in np.flatnonzero(wrong).tolist():
            given = float(steers[number])
            if not abs(clip_rounding(given, -1.0, 1.0)) <= 1.0:
                self._errors[number] = UserError(
                    f"update_batch returned {given:.9g} for this car in control step {step}; it "
                    "must return the steering action, a number in [-1, 1]"
                )
                rows[number, SKIPPED] = 1.0
        return steers

    def _complete(self) -> int:
        """Complete the control steps of the cars that touch something, because the compiled step
        stops at a contact. Returns the number of these cars whose drives go on."""
        rows, fleet = self._fleet.cars, self._fleet.arrays
        waiting, running = (rows[:, SKIPPED] == 0.0) & (rows[:, DONE] < PHYSICS_STEPS), 0
        for number in np.flatnonzero(waiting).tolist():
            try:
                self._worlds[number].complete()
            except UserError as error:  # PyBullet is not installed
                self._errors[number] = error
                rows[number, SKIPPED] = 1.0
                continue
            going = observe_rides(number, number + 1, fleet, self._arrays, PHYSICS_STEPS)
            running += going[0]
        return running

    def _outcome(self, number: int) -> Outcome:
        ride, arrays, row = self._rides[number], self._arrays, self._fleet.cars[number]
        driven, delay = int(row[STEPS]), int(arrays.delays[number])
        log, centre = arrays.log[number], ride.lane.centre
        curves = np.zeros((driven, 5))
        curves[:, 0] = np.arange(driven) / FREQUENCY_HZ
        curves[:, 1:3] = log[:driven, [LOG_OFFSET, LOG_ANGLE]]
        curves[:delay, 3] = np.nan
        late = max(driven - delay, 0)
        curves[delay:, 3:] = curves[:late, 1:3] - (centre, 0.0)
        if number in self._errors:
            return Outcome(ride.number, self._errors[number], curves)
        code = int(arrays.ended[number])
        states = log[1 : driven + 1, :LOG_STEER]
        result = Driven(
            after=np.column_stack((states, log[:driven, LOG_STEER])),
            ended=ENDINGS[code - 1] if code else None,
            laps_begun=int(row[LAP]),
            distance_m=float(row[MEMORY_AT + ODOMETER]),
            blind_steps=min(delay, driven),
            noisy=ride.disturbance.noise,
        ).result(ride.steps, ride.road, centre, FREQUENCY_HZ)
        return Outcome(ride.number, result, curves)

    def __enter__(self) -> "_Batch":
        return self

    def __exit__(self, *_: object) -> None:
        for world in self._worlds:
            world.close()


def _arrays(rides: list[_Ride], masses: list[float]) -> RideArrays:
    count, longest = len(rides), max(ride.steps for ride in rides)
    arrays = RideArrays(
        seen=np.full((count, OBSERVED), np.nan),
        log=np.zeros((count, longest + 1, LOG)),
        ended=np.zeros(count, np.int64),
        steps=np.array([ride.steps for ride in rides]),
        delays=np.array(
            [delay_steps(ride.disturbance.delay_s, 1.0 / FREQUENCY_HZ) for ride in rides]
        ),
        lane_centres=np.array([ride.lane.centre for ride in rides]),
        noisy=np.array([ride.disturbance.noise for ride in rides]),
        errors=np.zeros((count, longest, 5)),
        gusts=np.zeros((count, longest)),
        masses=np.array(masses),
    )
    for number, ride in enumerate(rides):
        of, drawn = ride.disturbance, slice(ride.steps)
        if of.noise:
            normal = of.noise_rng(ride.seed).normal(size=(ride.steps, 5))
            arrays.errors[number, drawn] = NOISE_STD * normal
        if of.wind:
            gusts = of.gusts(1.0 / FREQUENCY_HZ, ride.seed)
            arrays.gusts[number, drawn] = [gusts.step() for _ in range(ride.steps)]
    return arrays
