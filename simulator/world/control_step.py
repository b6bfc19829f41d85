"""The control step of cars that touch nothing, in compiled code, for the rows of a `fleet`.

If a car touches something, this code moves it only up to that physics step. `World.complete`
computes the rest of its control step.
"""

from runtime.jit import borrowed, compiled, compiled_for_threads
from simulator.arrays import FloatArray
from simulator.track.piece_table import TRACK_LENGTH, Table
from simulator.vehicle.dynamics import MEMORY, MOTION, Work, make_work
from simulator.vehicle.track_state import TRACK_S, TRACK_STATE_SIZE, measure_track_state
from simulator.world.collisions import CONTACT_MARGIN_M
from simulator.world.fleet import (
    COMMAND_AT,
    DONE,
    GROUND_AT,
    IN_CONTACT,
    LAP,
    LAP_START,
    MEMORY_AT,
    MOTION_AT,
    ROAD,
    SKIPPED,
    STEPS,
    TABLE_BEGIN,
    TABLE_END,
    TRACK_AT,
    TRAFFIC,
    WALL_OFFSET,
    WALLS_BEGIN,
    WALLS_END,
    Arrays,
)
from simulator.world.free_motion import advance_free


@compiled
def lend(fleet: Arrays) -> Arrays:
    """Return the fleet's arrays without reference counting, which would slow down each view of them
    (see `runtime.jit.borrowed`)."""
    cars, params, other, tables, left, right, roads, others, move = fleet
    return (
        borrowed(cars),
        borrowed(params),
        borrowed(other),
        borrowed(tables),
        borrowed(left),
        borrowed(right),
        borrowed(roads),
        borrowed(others),
        borrowed(move),
    )


@compiled
def lend_work(work: Work) -> Work:
    """Return the work arrays without reference counting, which would slow down each view of them
    (see `runtime.jit.borrowed`)."""
    axes, wheels, slip_gain, velocity, turned, wrench = work
    return (
        borrowed(axes),
        borrowed(wheels),
        borrowed(slip_gain),
        borrowed(velocity),
        borrowed(turned),
        borrowed(wrench),
    )


@compiled
def advance_car(number: int, fleet: Arrays, steps: int, work: Work) -> bool:
    """Advance car `number` by a control step of `steps` physics steps, or until the car touches
    something. Stores the number of physics steps done in the car's column DONE. Returns whether all
    physics steps are done. A car whose column SKIPPED is not 0 is not moved, because it drives
    among moving wrecks. `work` is memory for the steps."""
    cars, params, other, tables, left, right, roads, others, move = fleet
    car = cars[number]
    if car[SKIPPED] != 0.0:
        return False
    road = roads[int(car[ROAD])]
    table = tables[int(road[TABLE_BEGIN]) : int(road[TABLE_END])]
    begin, end, traffic = int(road[WALLS_BEGIN]), int(road[WALLS_END]), int(car[TRAFFIC])
    g = road[GROUND_AT:WALL_OFFSET]
    done = advance_free(
        params[number : number + 1],
        other,
        table,
        (g[0], g[1], g[2], g[3], g[4]),
        (road[WALL_OFFSET], left[begin:end], right[begin:end]),
        car[MOTION_AT : MOTION_AT + MOTION],
        car[MEMORY_AT : MEMORY_AT + MEMORY],
        car[COMMAND_AT : COMMAND_AT + 4],
        others[number, :traffic],
        move[number, :traffic],
        0,
        steps,
        CONTACT_MARGIN_M if car[IN_CONTACT] != 0.0 else 0.0,
        work,
    )
    car[DONE] = done
    if done > 0:
        car[IN_CONTACT] = 0.0
    if done < steps:
        return False
    car[STEPS] += 1.0
    measure_car(table, car)
    return True


@compiled
def measure_car(table: Table, car: FloatArray) -> None:
    """Update the track state and the number of laps in `car`, a row (48,) of the fleet. Crossing
    the start line adds a lap; crossing the line backwards subtracts one."""
    track = car[TRACK_AT : TRACK_AT + TRACK_STATE_SIZE]
    before = track[TRACK_S]
    measure_track_state(
        table, car[MOTION_AT : MOTION_AT + MOTION], car[MEMORY_AT : MEMORY_AT + MEMORY], track
    )
    moved, half = track[TRACK_S] - before, 0.5 * table[0, TRACK_LENGTH]
    if moved < -half:
        car[LAP] += 1.0
        car[LAP_START] = car[STEPS]
    elif moved > half:
        car[LAP] -= 1.0


@compiled_for_threads
def advance_cars(begin: int, end: int, fleet: Arrays, steps: int) -> None:
    """Advance the cars `begin` to `end` - 1 by a control step of `steps` physics steps."""
    work, lent = make_work(), lend(fleet)
    for number in range(begin, end):
        advance_car(number, lent, steps, lend_work(work))
