"""The compiled control step of many drives with exact states.

A drive is called a ride, and its car is a row of a `Fleet`. A control step consists of
`command_rides`, the motion of the cars (`simulator.world.control_step`), and `observe_rides`. SI
units, track frame.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.drive.disturbance import push
from controllers.interface import (
    ANGLE,
    CURVATURE,
    HEADING,
    TO_LANE_CENTRE,
    VX,
    VY,
    YAW_RATE,
)
from controllers.perception.sources import LOOK_AHEAD_S
from runtime.jit import compiled, compiled_for_threads
from simulator.arrays import FloatArray
from simulator.env.control_step import ending_of
from simulator.env.reward import ALL_ENDS
from simulator.track.piece_table import CURVATURE as PIECE_CURVATURE
from simulator.track.piece_table import Table, index_at
from simulator.vehicle import track_state
from simulator.vehicle.dynamics import MOTION
from simulator.world.fleet import (
    COMMAND_AT,
    DONE,
    MOTION_AT,
    ROAD,
    SKIPPED,
    STEPS,
    TABLE_BEGIN,
    TABLE_END,
    TOUCHED,
    TRACK_AT,
    Arrays,
)
from trackfeatures.road_class import LOOK_AHEAD_M, RoadClass, classify_heading

# A row of `log` (LOG,): the true state before a control step, with the class of the road and the
# curvature just ahead, and the steering action in this step.
LOG_OFFSET, LOG_ANGLE, LOG_VX, LOG_VY, LOG_STEER, LOG_HEADING, LOG_AHEAD, LOG = range(8)
STRAIGHT = float(RoadClass.STRAIGHT)


class RideArrays(NamedTuple):
    """The drives of the N cars of a fleet, of at most S control steps each."""

    seen: FloatArray
    """(N, OBSERVED): the rows of `Observations` of the present step."""
    log: FloatArray
    """(N, S + 1, LOG): a row for each control step, with the columns LOG_OFFSET to LOG_AHEAD."""
    ended: NDArray[np.int64]
    """(N,): code of the end of each drive (`simulator.env.reward.ending_code`); 0 before its end.
    """
    steps: NDArray[np.int64]
    """(N,): control steps requested."""
    delays: NDArray[np.int64]
    """(N,): delay of the perception in control steps."""
    lane_centres: FloatArray
    """(N,): centre of the lane to follow, m left of the track's centre."""
    noisy: NDArray[np.bool_]
    """(N,): whether `errors` are added to the observations."""
    errors: FloatArray
    """(N, S, 5): errors of offset (m), angle (rad), vx and vy (m/s) and yaw rate (rad/s) in each
    control step."""
    gusts: FloatArray
    """(N, S): side wind in each control step, m/s, positive from the right."""
    masses: FloatArray
    """(N,): mass of each car, kg."""


@compiled_for_threads
def command_rides(fleet: Arrays, rides: RideArrays, steers: FloatArray, frequency_hz: int) -> None:
    """Begin a control step of all cars whose drives go on. The steering actions are set to `steers`
    (N,), clipped to [-1, 1], and the effect of the wind over 1 / `frequency_hz` s is added to the
    cars' velocities.

    `fleet` has the arrays of the N cars (`Fleet.arrays`), `rides` the arrays of their drives.
    """
    cars = fleet[0]
    for number in range(len(cars)):
        car = cars[number]
        if car[SKIPPED] != 0.0:
            continue
        step = int(car[STEPS])
        car[TOUCHED] = car[DONE] = 0.0
        rides.log[number, step, LOG_STEER] = steers[number]
        car[COMMAND_AT] = min(max(steers[number], -1.0), 1.0)
        wind = rides.gusts[number, step]
        if wind != 0.0:
            track, mass = car[TRACK_AT:], rides.masses[number]
            yaw, vx = track[track_state.YAW], track[track_state.VX]
            push(car[MOTION_AT : MOTION_AT + MOTION], yaw, vx, wind, mass, frequency_hz)


@compiled_for_threads
def observe_rides(
    begin: int, end: int, fleet: Arrays, rides: RideArrays, steps: int
) -> tuple[int, int]:
    """Observe the cars `begin` to `end` - 1 after a control step of `steps` physics steps.

    A car that has not completed the step is not observed. A car whose drive is over is marked, and
    later calls skip it. Returns the number of drives that go on, and the number of cars that did
    not complete the step.
    """
    running, incomplete = 0, 0
    for number in range(begin, end):
        car = fleet[0][number]
        if car[SKIPPED] != 0.0:
            continue
        if car[DONE] < steps:
            incomplete += 1
        elif note_state(number, fleet, rides):
            observe_ride(number, int(car[STEPS]), car, rides)
            running += 1
        else:
            car[SKIPPED] = 1.0
    return running, incomplete


@compiled
def note_state(number: int, fleet: Arrays, rides: RideArrays) -> bool:
    """Write the true state of car `number` into `rides.log`; return whether its drive goes on."""
    car = fleet[0][number]
    road = fleet[6][int(car[ROAD])]
    table: Table = fleet[3][int(road[TABLE_BEGIN]) : int(road[TABLE_END])]
    track, step = car[TRACK_AT:], int(car[STEPS])
    s, vx = track[track_state.TRACK_S], track[track_state.VX]
    here, there = index_at(table, s), index_at(table, s + LOOK_AHEAD_M)
    heading = classify_heading(table[here, PIECE_CURVATURE], table[there, PIECE_CURVATURE])
    ahead = index_at(table, s + LOOK_AHEAD_S * max(vx, 0.0))
    row = rides.log[number, step]
    row[LOG_OFFSET], row[LOG_ANGLE] = track[track_state.TRACK_OFFSET], track[track_state.ANGLE]
    row[LOG_VX], row[LOG_VY] = vx, track[track_state.VY]
    row[LOG_HEADING], row[LOG_AHEAD] = heading.value, table[ahead, PIECE_CURVATURE]
    if step == 0:
        return True
    rides.ended[number] = ending_of(car, road, ALL_ENDS)
    return bool(rides.ended[number] == 0 and step < rides.steps[number])


@compiled
def observe_ride(number: int, step: int, car: FloatArray, rides: RideArrays) -> None:
    """Fill `rides.seen[number]` with the observation of `car`, row `number` of the fleet, at the
    control step `step`.

    The road is observed with the delay of the perception, the car's motion without delay. Noise is
    added if `rides.noisy` is set. In the steps before the first delayed observation, the offset and
    the angle are 0, and the road is straight.
    """
    seen, track = rides.seen[number], car[TRACK_AT:]
    at = step - rides.delays[number]
    seen[TO_LANE_CENTRE], seen[ANGLE], seen[HEADING], seen[CURVATURE] = 0.0, 0.0, STRAIGHT, np.nan
    if at >= 0:
        row = rides.log[number, at]
        seen[TO_LANE_CENTRE] = row[LOG_OFFSET] - rides.lane_centres[number]
        seen[ANGLE], seen[HEADING] = row[LOG_ANGLE], row[LOG_HEADING]
        seen[CURVATURE] = row[LOG_AHEAD]
    seen[VX], seen[VY] = track[track_state.VX], track[track_state.VY]
    seen[YAW_RATE] = track[track_state.YAW_RATE]
    if rides.noisy[number]:
        errors = rides.errors[number, step]
        seen[TO_LANE_CENTRE] += errors[0]
        seen[ANGLE] += errors[1]
        seen[VX] += errors[2]
        seen[VY] += errors[3]
        seen[YAW_RATE] += errors[4]
