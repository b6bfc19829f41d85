"""One step of all traffic cars: who leads whom, lane changes, speeds, places.

Everything is in the track frame: s along the centre line, y to the left, m and m/s. A car in the
middle of a lane change holds both lanes: others keep behind it in either.
"""

import math

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.track import kernel
from simulator.traffic.idm import COMFORTABLE_BRAKING, STANDSTILL_GAP_M, idm_acceleration

# Columns of a car's row.
S, Y, SPEED, DESIRED, Y_FROM, Y_TO, DONE, CHANGE_M, REST_S, STRUCK = range(10)
CAR_COLUMNS = 10
# A car that was hit (STRUCK is 1) is moved by others: here it only stands in the way.
# Columns of a body's row: what others see of a car, or of the ego car (the last row).
B_S, B_RIGHT, B_LEFT, B_SPEED, B_HALF_LENGTH, B_DESIRED = range(6)
BODY_COLUMNS = 6

SIDE_MARGIN_M = 0.3  # cars that pass closer than this are in each other's way
CHANGE_TIME_S = 4.0
SHORTEST_CHANGE_M = 25.0
REST_BETWEEN_CHANGES_S = 3.0
SAFE_BRAKING = COMFORTABLE_BRAKING  # a lane change asks no more than this of anyone
WORTH_CHANGING = 0.2  # m/s2 to be gained
LEAST_STRETCH = 0.05  # of a metre of s, near the middle of a bend
POLITENESS = 0.2  # MOBIL: how much the loss of the new follower counts

Table = NDArray[np.float64]


@compiled
def ahead_m(from_s: float, to_s: float, length: float) -> float:
    """How far `to_s` lies ahead of `from_s` on a loop, in [-length/2, length/2)."""
    return (to_s - from_s + 0.5 * length) % length - 0.5 * length


@compiled
def neighbour(
    bodies: Table,
    me: int,
    s: float,
    right: float,
    left: float,
    half_length: float,
    length: float,
    ahead: bool,
) -> tuple[int, float]:
    """The nearest body in the corridor [right, left], ahead or behind: (row, bumper gap in m).

    (-1, inf) when there is none. The gap is negative when the two overlap lengthwise. Bodies at
    the same s count as ahead in the order of their rows, so that every pair has one follower.
    """
    found, smallest = -1, math.inf
    for other in range(bodies.shape[0]):
        if other == me:
            continue
        if bodies[other, B_RIGHT] > left + SIDE_MARGIN_M:
            continue
        if bodies[other, B_LEFT] < right - SIDE_MARGIN_M:
            continue
        distance = ahead_m(s, bodies[other, B_S], length)
        is_ahead = distance > 0.0 or (distance == 0.0 and other > me)
        if is_ahead != ahead:
            continue
        gap = abs(distance) - bodies[other, B_HALF_LENGTH] - half_length
        if gap < smallest:
            found, smallest = other, gap
    return found, smallest


@compiled
def follow(
    bodies: Table,
    me: int,
    s: float,
    speed: float,
    desired: float,
    right: float,
    left: float,
    half_length: float,
    length: float,
) -> float:
    """Acceleration (m/s2) of a car at `s` in the corridor [right, left]."""
    lead, gap = neighbour(bodies, me, s, right, left, half_length, length, True)
    lead_speed = bodies[lead, B_SPEED] if lead >= 0 else speed
    return idm_acceleration(gap, speed, lead_speed, desired)


@compiled
def room_in(
    bodies: Table,
    me: int,
    s: float,
    speed: float,
    right: float,
    left: float,
    half_length: float,
    length: float,
) -> tuple[bool, float]:
    """Whether a car may move into the corridor: (both gaps are safe, follower's loss in m/s2)."""
    lead, gap = neighbour(bodies, me, s, right, left, half_length, length, True)
    if lead >= 0:
        lead_speed = bodies[lead, B_SPEED]
        if gap < STANDSTILL_GAP_M + 0.5 * speed:
            return False, 0.0
        # Judged without a wish for speed of its own: only what the leader asks.
        if idm_acceleration(gap, speed, lead_speed, 1e3) < -SAFE_BRAKING:
            return False, 0.0
    behind, gap = neighbour(bodies, me, s, right, left, half_length, length, False)
    if behind < 0:
        return True, 0.0
    his = bodies[behind, B_SPEED]
    if gap < STANDSTILL_GAP_M + 0.5 * his:
        return False, 0.0
    after = idm_acceleration(gap, his, speed, bodies[behind, B_DESIRED])
    before = follow(
        bodies,
        behind,
        bodies[behind, B_S],
        his,
        bodies[behind, B_DESIRED],
        bodies[behind, B_RIGHT],
        bodies[behind, B_LEFT],
        bodies[behind, B_HALF_LENGTH],
        length,
    )
    return after >= -SAFE_BRAKING, before - after


@compiled
def show(cars: Table, bodies: Table, half_length: float, half_width: float) -> None:
    """Writes what others see of the cars into the first rows of `bodies`."""
    for i in range(cars.shape[0]):
        if cars[i, STRUCK] > 0.0:
            continue
        bodies[i, B_S] = cars[i, S]
        bodies[i, B_RIGHT] = min(cars[i, Y], cars[i, Y_TO]) - half_width
        bodies[i, B_LEFT] = max(cars[i, Y], cars[i, Y_TO]) + half_width
        bodies[i, B_SPEED] = cars[i, SPEED]
        bodies[i, B_HALF_LENGTH] = half_length
        bodies[i, B_DESIRED] = cars[i, DESIRED]


@compiled
def choose_lane(
    cars: Table, bodies: Table, i: int, lane_y: Table, half_width: float, length: float
) -> None:
    """Starts a lane change of car `i` where it is safe and pays (MOBIL, Kesting et al. 2007)."""
    y, speed, half_length = cars[i, Y_TO], cars[i, SPEED], bodies[i, B_HALF_LENGTH]
    s, desired = cars[i, S], cars[i, DESIRED]
    here = follow(bodies, i, s, speed, desired, y - half_width, y + half_width, half_length, length)
    best, best_gain = y, WORTH_CHANGING
    spacing = abs(lane_y[0] - lane_y[1])
    for target in lane_y:
        if abs(abs(target - y) - spacing) > 0.01:
            continue  # not the lane beside this one
        right, left = target - half_width, target + half_width
        safe, loss = room_in(bodies, i, s, speed, right, left, half_length, length)
        if not safe:
            continue
        there = follow(bodies, i, s, speed, desired, right, left, half_length, length)
        gain = there - here - POLITENESS * loss
        if gain > best_gain:
            best, best_gain = target, gain
    if best != y:
        cars[i, Y_FROM], cars[i, Y_TO], cars[i, DONE] = y, best, 0.0
        cars[i, CHANGE_M] = max(SHORTEST_CHANGE_M, CHANGE_TIME_S * speed)
        cars[i, REST_S] = REST_BETWEEN_CHANGES_S


@compiled
def along_centre(table: Table, s: float, y: float, way: float) -> float:
    """How far s grows while a car goes `way` m at the offset `y`: a lane inside a bend is shorter
    than the centre line. Exact across the joints of a track, where the bend may change at once."""
    gained, index = 0.0, kernel.index_at(table, s)
    at = kernel.wrap(table, s)
    for _ in range(table.shape[0] + 1):
        stretch = max(1.0 - table[index, kernel.CURVATURE] * y, LEAST_STRETCH)
        left = max(table[index, kernel.S0] + table[index, kernel.LENGTH] - at, 0.0)
        if way <= left * stretch:
            return float(gained + way / stretch)
        gained += left
        way -= left * stretch
        index = (index + 1) % table.shape[0]
        at = table[index, kernel.S0]
    return gained


@compiled
def move(cars: Table, i: int, advance_m: float, dt: float, length: float) -> None:
    """Moves car `i` along its lane; sideways by the way made, so a car at rest stays in place."""
    cars[i, S] = (cars[i, S] + advance_m) % length
    if cars[i, DONE] >= 1.0:
        cars[i, REST_S] = max(cars[i, REST_S] - dt, 0.0)
        return
    done = min(cars[i, DONE] + advance_m / cars[i, CHANGE_M], 1.0)
    share = done**3 * (10.0 - 15.0 * done + 6.0 * done**2)  # smooth to the second derivative
    cars[i, DONE] = done
    cars[i, Y] = cars[i, Y_FROM] + share * (cars[i, Y_TO] - cars[i, Y_FROM])


@compiled
def advance(
    cars: Table,
    bodies: Table,
    dt: float,
    length: float,
    lane_y: Table,
    table: Table,
    speed_limit: Table,
    half_length: float,
    half_width: float,
) -> None:
    """One step of `dt` s. `speed_limit` holds one value a cell around the loop.

    Lane changes are decided one car after the other, each seeing the decisions before it; all
    accelerations come from the state before the step.
    """
    count = cars.shape[0]
    if lane_y.shape[0] > 1:
        for i in range(count):
            idle = cars[i, DONE] >= 1.0 and cars[i, REST_S] <= 0.0
            if idle and cars[i, STRUCK] == 0.0:
                choose_lane(cars, bodies, i, lane_y, half_width, length)
                show(cars, bodies, half_length, half_width)
    cells = speed_limit.shape[0]
    for i in range(count):
        if cars[i, STRUCK] > 0.0:
            continue
        cell = int(cars[i, S] / length * cells) % cells
        next_cell = (int((cars[i, S] + cars[i, SPEED] * dt) / length * cells) + 1) % cells
        limit = min(speed_limit[cell], speed_limit[next_cell])
        desired = min(cars[i, DESIRED], limit)
        right, left = bodies[i, B_RIGHT], bodies[i, B_LEFT]
        speed = cars[i, SPEED]
        wish = follow(bodies, i, cars[i, S], speed, desired, right, left, half_length, length)
        # The limits fall no faster than one brakes in comfort, so they can be kept to exactly.
        cars[i, SPEED] = min(max(speed + wish * dt, 0.0), limit)
        way = 0.5 * (speed + cars[i, SPEED]) * dt
        move(cars, i, along_centre(table, cars[i, S], cars[i, Y], way), dt, length)
    show(cars, bodies, half_length, half_width)


@compiled
def place(cars: Table, table: Table, poses: Table) -> None:
    """Fills `poses` (n, 6): x, y, z, roll, pitch, yaw of the ground point under each car.

    Angles are those of pybullet (R = Rz(yaw) Ry(pitch) Rx(roll), pitch positive nose down); the
    car stands square on the road plane. Leaves the poses of struck cars alone.
    """
    for i in range(cars.shape[0]):
        if cars[i, STRUCK] > 0.0:
            continue
        s, y = cars[i, S], cars[i, Y]
        index = kernel.index_at(table, s)
        x0, y0, _, heading, _ = kernel.pose_at(table, s)
        z, nx, ny, nz = kernel.surface(table, index, s, y)
        sideways = 0.0
        if cars[i, DONE] < 1.0:
            done = cars[i, DONE]
            slope = 30.0 * done**2 * (1.0 - done) ** 2 / cars[i, CHANGE_M]
            sideways = math.atan(slope * (cars[i, Y_TO] - cars[i, Y_FROM]))
        yaw = heading + sideways
        poses[i, 0] = x0 - y * math.sin(heading)
        poses[i, 1] = y0 + y * math.cos(heading)
        poses[i, 2] = z
        forward = nx * math.cos(yaw) + ny * math.sin(yaw)
        poses[i, 3] = math.asin(nx * math.sin(yaw) - ny * math.cos(yaw))
        poses[i, 4] = math.atan2(forward, nz)
        poses[i, 5] = math.atan2(math.sin(yaw), math.cos(yaw))


@compiled
def brake_ahead(squared: Table, gain: float) -> None:
    """Lower the squared speed limits (n,) of cells around a loop where the next one's is lower by
    more than the `gain` that can be braked off within a cell."""
    cells = squared.shape[0]
    for cell in range(2 * cells - 1, -1, -1):  # twice round: the end brakes for the beginning
        ahead = squared[(cell + 1) % cells] + gain
        squared[cell % cells] = min(squared[cell % cells], ahead)
