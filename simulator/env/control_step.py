"""One control step of an environment's cars in compiled code: physics, track features, range beams,
reward and ending, for the rows of a fleet. SI units, track frame."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.jit import borrowed, callable_from_compiled, compiled, compiled_for_threads
from simulator.arrays import FloatArray
from simulator.env.reward import ending_code, step_reward
from simulator.sensors.beams import track_beams
from simulator.track.piece_table import CURVATURE, foot_offset, index_near
from simulator.vehicle.dynamics import PIECE, make_work
from simulator.vehicle.track_state import (
    ANGLE,
    TRACK_OFFSET,
    TRACK_S,
    TRACK_SPEED,
    VX,
    VY,
    YAW,
)
from simulator.world.control_step import advance_car, lend, lend_work
from simulator.world.fleet import (
    EDGE,
    HALF_WIDTH,
    LANE_WIDTH,
    LANES,
    LINES_AT,
    MARKINGS,
    MEMORY_AT,
    MOTION_AT,
    ROAD,
    TABLE_BEGIN,
    TABLE_END,
    TOUCHED,
    TRACK_AT,
    WALL,
    Arrays,
)
from simulator.world.world import BACKWARDS_SPEED_M_S
from trackfeatures.definitions import lane_offset
from trackfeatures.measurement import (
    in_lane_distances,
    lane_centre,
    lane_index,
    on_marking_distances,
)
from trackfeatures.road_class import LOOK_AHEAD_M, classify_heading
from trackfeatures.state_vector import STATE_SIZE, state_vector

for function in (
    *(classify_heading, lane_centre, lane_index, lane_offset),
    *(in_lane_distances, on_marking_distances, state_vector),
):
    callable_from_compiled(function)

# Columns of a row of `results` (RESULT,): reward; 1 + index of the event that ended the episode, or
# 0 if it continues; sum of the rewards of the episode; the five distances and the offset from the
# lane's centre (m), NaN if absent; class of the road.
REWARD, ENDED, SCORE, DISTANCES_AT, TO_LANE_CENTRE, HEADING, RESULT = 0, 1, 2, 3, 8, 9, 10

Outputs = tuple[NDArray[np.float32], FloatArray, FloatArray, FloatArray]
"""States (N, STATE_SIZE), results (N, RESULT), range beams (N, B) in m, and the noise to add to the
states, (N, STATE_SIZE) or (N, 0)."""
Rules = tuple[int, bool, float, float, FloatArray]
"""The rules of an environment: `ends_code` of the events that end an episode; whether the reward is
`step_reward`; the weight lambda of `step_reward`; the bound to which the values of the state
vectors are clipped; the angles (B,) of the range beams in rad."""


@compiled_for_threads
def step_cars(
    begin: int, end: int, fleet: Arrays, steps: int, outputs: Outputs, rules: Rules
) -> None:
    """Advance the cars `begin` to `end` - 1 by one control step of `steps` physics steps, and fill
    their `outputs` by the `rules` of the environment. A car that touches something stops before the
    end of the step, and its outputs are not filled; `Cars.step` completes its control step."""
    work, lent, filled = make_work(), lend(fleet), lend_outputs(outputs)
    for number in range(begin, end):
        if advance_car(number, lent, steps, lend_work(work)):
            observe_car(number, lent, filled, rules, False)


@compiled_for_threads
def observe_cars(
    begin: int, end: int, fleet: Arrays, outputs: Outputs, rules: Rules, first: bool
) -> None:
    """Fill the `outputs` of the cars `begin` to `end` - 1 by the `rules` of the environment. This
    is called after a step or, with `first` true, at the start of an episode."""
    lent, filled = lend(fleet), lend_outputs(outputs)
    for number in range(begin, end):
        observe_car(number, lent, filled, rules, first)


@compiled
def lend_outputs(outputs: Outputs) -> Outputs:
    """Return the arrays `outputs`, which compiled code then uses without reference counting.
    Counting would take longer than the arithmetic (see `runtime.jit.borrowed`)."""
    states, results, beams, noise = outputs
    return borrowed(states), borrowed(results), borrowed(beams), borrowed(noise)


@compiled
def observe_car(number: int, fleet: Arrays, outputs: Outputs, rules: Rules, first: bool) -> None:
    """Fill the `outputs` of car `number` by the `rules` of the environment. `first` is True at the
    start of an episode, when reward, score and ending are 0."""
    states, results, beams, noise = outputs
    ends, rewarded, weight, limit, angles = rules
    car, result = fleet[0][number], results[number]
    road = fleet[6][int(car[ROAD])]
    table = fleet[3][int(road[TABLE_BEGIN]) : int(road[TABLE_END])]
    track = car[TRACK_AT:]
    s, offset, angle = track[TRACK_S], track[TRACK_OFFSET], track[ANGLE]
    piece, z = int(car[MEMORY_AT + PIECE]), car[MOTION_AT + 2]
    measure_features(road, foot_offset(table, piece, s, offset, z), result[DISTANCES_AT:HEADING])
    here = index_near(table, s, piece)
    ahead = index_near(table, s + LOOK_AHEAD_M, here)
    heading = classify_heading(table[here, CURVATURE], table[ahead, CURVATURE])
    result[HEADING] = heading.value
    vector = state_vector(offset, angle, track[VX], track[VY], heading, road[HALF_WIDTH])
    for k in range(STATE_SIZE):
        value = vector[k] + noise[number, k] if noise.shape[1] else vector[k]
        states[number, k] = min(max(value, -limit), limit)
    if beams.shape[1]:
        x, y = car[MOTION_AT], car[MOTION_AT + 1]
        track_beams(table, here, x, y, track[YAW], angles, road[EDGE], beams[number])
    if first:
        result[REWARD] = result[ENDED] = result[SCORE] = 0.0
        return
    ended = ending_of(car, road, ends)
    result[ENDED] = ended
    if rewarded:
        result[REWARD] = step_reward(angle, offset, road[HALF_WIDTH], ended > 0, weight)
        result[SCORE] += result[REWARD]


@compiled
def ending_of(car: FloatArray, road: FloatArray, ends: int) -> int:
    """Return 1 + the index into ENDINGS of the event that ends the episode of a car; 0 if it
    continues. `car` and `road` are the rows of the car and of its road in the fleet, `ends` is the
    `ends_code` of the events that end an episode."""
    track = car[TRACK_AT:]
    return ending_code(
        abs(track[TRACK_OFFSET]) > road[EDGE],
        abs(track[ANGLE]) > 0.5 * math.pi or track[TRACK_SPEED] < BACKWARDS_SPEED_M_S,
        car[TOUCHED] == WALL,
        car[TOUCHED] != 0.0,
        ends,
    )


@compiled
def measure_features(road: FloatArray, offset: float, out: FloatArray) -> None:
    """Fill `out` (6,) with the five distances and the offset from the lane's centre, in m, of a car
    `offset` m left of the middle of `road` (ROAD_SIZE,). Absent values are NaN."""
    lanes, width = int(road[LANES]), road[LANE_WIDTH]
    lines: Any = road[LINES_AT : LINES_AT + 2 * MARKINGS].reshape(MARKINGS, 2)
    ml, mr = in_lane_distances(offset, lanes, width, lines)
    l, m, r = on_marking_distances(offset, lanes, width, lines)
    centre = lane_offset(ml, mr, l, m, r)
    out[0] = math.nan if ml is None else ml
    out[1] = math.nan if mr is None else mr
    out[2] = math.nan if l is None else l
    out[3] = math.nan if m is None else m
    out[4] = math.nan if r is None else r
    out[5] = math.nan if centre is None else centre
