"""Compiled functions on the table of all traffic cars: leaders, lane changes, speeds, positions.

`cars` (n, 10) has a row per traffic car; `bodies` (n + 1, 6) has the extent, speed and desired
speed of each traffic car and, in the last row, of the ego car. Track frame: s along the centre
line, y to the left, m and m/s; `length` is the length of the lap. During a lane change a car
occupies both lanes, and cars in both lanes follow it.
"""

import math

from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.track import piece_table
from simulator.traffic.idm import COMFORTABLE_BRAKING, STANDSTILL_GAP_M, idm_acceleration

# Columns of a car's row.
S, Y, SPEED, DESIRED, Y_FROM, Y_TO, CHANGE_PROGRESS, CHANGE_LENGTH_M, COOLDOWN_S, STRUCK = range(10)
CAR_COLUMNS = 10
# CHANGE_PROGRESS rises from 0 to 1 during a lane change of CHANGE_LENGTH_M. COOLDOWN_S is the time
# until the next lane change may start. A car with STRUCK = 1 was hit; physics moves it, and for the
# other cars it is an obstacle.
# Columns of a body's row: extent and speed of a car, for the decisions of other cars; the last row
# is the ego car.
B_S, B_RIGHT, B_LEFT, B_SPEED, B_HALF_LENGTH, B_DESIRED = range(6)
BODY_COLUMNS = 6

SIDE_MARGIN_M = 0.3  # cars with a smaller lateral gap than this are in one corridor
CHANGE_TIME_S = 4.0
MIN_CHANGE_LENGTH_M = 25.0
CHANGE_COOLDOWN_S = 3.0
SAFE_BRAKING = COMFORTABLE_BRAKING  # m/s2: largest braking that a lane change may cause
MIN_GAIN = 0.2  # m/s2: least gain in acceleration for a lane change
MIN_LENGTH_RATIO = 0.05  # least assumed ratio of lane length to centre-line length in a bend
POLITENESS = 0.2  # MOBIL: weight of the acceleration that the new follower loses


@compiled
def signed_distance(from_s: float, to_s: float, length: float) -> float:
    """Return the distance (m) of `to_s` ahead of `from_s` on a loop, in [-length/2, length/2)."""
    return (to_s - from_s + 0.5 * length) % length - 0.5 * length


@compiled
def nearest_body(
    bodies: FloatArray,
    me: int,
    s: float,
    right: float,
    left: float,
    half_length: float,
    length: float,
    ahead: bool,
) -> tuple[int, float]:
    """Return (row in `bodies`, bumper gap in m) of the nearest body ahead of `s`, or behind `s` if
    `ahead` is False. The row `me` does not count, nor do bodies outside the lateral range `right`
    to `left` (m), widened by 0.3 m on both sides. `half_length` (m) is half the length of the car
    at `s`.

    Returns (-1, inf) if there is no such body. The gap is negative if the car and the body overlap
    lengthwise. Of two bodies at the same s, the one with the higher row is ahead, so that one of
    the two follows the other.
    """
    found, smallest = -1, math.inf
    for other in range(bodies.shape[0]):
        if other == me:
            continue
        if bodies[other, B_RIGHT] > left + SIDE_MARGIN_M:
            continue
        if bodies[other, B_LEFT] < right - SIDE_MARGIN_M:
            continue
        distance = signed_distance(s, bodies[other, B_S], length)
        is_ahead = distance > 0.0 or (distance == 0.0 and other > me)
        if is_ahead != ahead:
            continue
        gap = abs(distance) - bodies[other, B_HALF_LENGTH] - half_length
        if gap < smallest:
            found, smallest = other, gap
    return found, smallest


@compiled
def following_acceleration(
    bodies: FloatArray,
    me: int,
    s: float,
    speed: float,
    desired: float,
    right: float,
    left: float,
    half_length: float,
    length: float,
) -> float:
    """Return the IDM acceleration (m/s2) of the car `me`, a row of `bodies`, behind the nearest
    body in the lateral range `right` to `left` (m). The car is at `s` (m), drives at `speed` (m/s),
    wants to drive at `desired` (m/s), and is 2 x `half_length` (m) long. `length` (m) is the length
    of the lap."""
    lead, gap = nearest_body(bodies, me, s, right, left, half_length, length, True)
    lead_speed = bodies[lead, B_SPEED] if lead >= 0 else speed
    return idm_acceleration(gap, speed, lead_speed, desired)


@compiled
def lane_change_safe(
    bodies: FloatArray,
    me: int,
    s: float,
    speed: float,
    right: float,
    left: float,
    half_length: float,
    length: float,
) -> tuple[bool, float]:
    """Return whether the car `me` (a row of `bodies`) at `s` (m) may change into the lateral range
    `right` to `left` (m), that is, whether the gaps to the new leader and to the new follower are
    safe. Also return the acceleration (m/s2) that the new follower loses. `half_length` (m) is half
    the length of the car, `length` (m) the length of the lap."""
    lead, gap = nearest_body(bodies, me, s, right, left, half_length, length, True)
    if lead >= 0:
        lead_speed = bodies[lead, B_SPEED]
        if gap < STANDSTILL_GAP_M + 0.5 * speed:
            return False, 0.0
        # The desired speed is unlimited here, so that only the leader has an effect.
        if idm_acceleration(gap, speed, lead_speed, 1e3) < -SAFE_BRAKING:
            return False, 0.0
    behind, gap = nearest_body(bodies, me, s, right, left, half_length, length, False)
    if behind < 0:
        return True, 0.0
    follower_speed = bodies[behind, B_SPEED]
    if gap < STANDSTILL_GAP_M + 0.5 * follower_speed:
        return False, 0.0
    after = idm_acceleration(gap, follower_speed, speed, bodies[behind, B_DESIRED])
    before = following_acceleration(
        bodies,
        behind,
        bodies[behind, B_S],
        follower_speed,
        bodies[behind, B_DESIRED],
        bodies[behind, B_RIGHT],
        bodies[behind, B_LEFT],
        bodies[behind, B_HALF_LENGTH],
        length,
    )
    return after >= -SAFE_BRAKING, before - after


@compiled
def update_bodies(
    cars: FloatArray, bodies: FloatArray, half_length: float, half_width: float
) -> None:
    """Update the rows of all traffic cars in `bodies` (n + 1, 6), except struck cars. `half_length`
    and `half_width` (m) are half the size of a traffic car."""
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
def decide_lane_change(
    cars: FloatArray,
    bodies: FloatArray,
    i: int,
    lane_y: FloatArray,
    half_width: float,
    length: float,
) -> None:
    """Start a lane change of car `i` into the best adjacent lane, if it is safe and the car gains
    at least 0.2 m/s2 more acceleration than 0.2 times the new follower's loss (MOBIL, Kesting
    2007). `lane_y` (lanes,) are the lateral positions (m) of the lane centres, `half_width` (m) is
    half the width of the car, and `length` (m) the length of the lap."""
    y, speed, half_length = cars[i, Y_TO], cars[i, SPEED], bodies[i, B_HALF_LENGTH]
    s, desired = cars[i, S], cars[i, DESIRED]
    here = following_acceleration(
        bodies, i, s, speed, desired, y - half_width, y + half_width, half_length, length
    )
    best, best_gain = y, MIN_GAIN
    spacing = abs(lane_y[0] - lane_y[1])
    for target in lane_y:
        if abs(abs(target - y) - spacing) > 0.01:
            continue  # `target` is not a lane beside this one
        right, left = target - half_width, target + half_width
        safe, loss = lane_change_safe(bodies, i, s, speed, right, left, half_length, length)
        if not safe:
            continue
        there = following_acceleration(
            bodies, i, s, speed, desired, right, left, half_length, length
        )
        gain = there - here - POLITENESS * loss
        if gain > best_gain:
            best, best_gain = target, gain
    if best != y:
        cars[i, Y_FROM], cars[i, Y_TO], cars[i, CHANGE_PROGRESS] = y, best, 0.0
        cars[i, CHANGE_LENGTH_M] = max(MIN_CHANGE_LENGTH_M, CHANGE_TIME_S * speed)
        cars[i, COOLDOWN_S] = CHANGE_COOLDOWN_S


@compiled
def centre_line_advance(table: FloatArray, s: float, y: float, distance: float) -> float:
    """Return the increase of s (m) while a car drives `distance` m at the lateral offset `y`.

    A lane on the inside of a bend is shorter than the centre line. The result is exact across the
    joints of pieces, where the curvature jumps.
    """
    gained, index = 0.0, piece_table.index_at(table, s)
    at = piece_table.wrap(table, s)
    for _ in range(table.shape[0] + 1):
        length_ratio = max(1.0 - table[index, piece_table.CURVATURE] * y, MIN_LENGTH_RATIO)
        left = max(table[index, piece_table.S0] + table[index, piece_table.LENGTH] - at, 0.0)
        if distance <= left * length_ratio:
            return float(gained + distance / length_ratio)
        gained += left
        distance -= left * length_ratio
        index = (index + 1) % table.shape[0]
        at = table[index, piece_table.S0]
    return gained


@compiled
def move_car(cars: FloatArray, i: int, advance_m: float, dt: float, length: float) -> None:
    """Advance car `i` (a row of `cars` (n, 10)) along its lane by `advance_m` within `dt` s;
    `length` (m) is the length of the lap. The lateral motion of a lane change depends on the
    distance driven, so a car at rest does not move sideways."""
    cars[i, S] = (cars[i, S] + advance_m) % length
    if cars[i, CHANGE_PROGRESS] >= 1.0:
        cars[i, COOLDOWN_S] = max(cars[i, COOLDOWN_S] - dt, 0.0)
        return
    done = min(cars[i, CHANGE_PROGRESS] + advance_m / cars[i, CHANGE_LENGTH_M], 1.0)
    share = done**3 * (10.0 - 15.0 * done + 6.0 * done**2)  # smooth to the second derivative
    cars[i, CHANGE_PROGRESS] = done
    cars[i, Y] = cars[i, Y_FROM] + share * (cars[i, Y_TO] - cars[i, Y_FROM])


@compiled
def step_traffic(
    cars: FloatArray,
    bodies: FloatArray,
    dt: float,
    length: float,
    lane_y: FloatArray,
    table: FloatArray,
    speed_limit: FloatArray,
    half_length: float,
    half_width: float,
) -> None:
    """Advance all cars by one step of `dt` s. `lane_y` (lanes,) are the lateral positions (m) of
    the lane centres, `table` is the track's table, and `length` (m) the length of the lap.
    `speed_limit` (cells,) in m/s holds in equal parts of the lap. `half_length` and `half_width`
    (m) are half the size of a car.

    Lane changes are decided one car after another, based on the earlier decisions. All
    accelerations are computed from the state before the step.
    """
    count = cars.shape[0]
    if lane_y.shape[0] > 1:
        for i in range(count):
            idle = cars[i, CHANGE_PROGRESS] >= 1.0 and cars[i, COOLDOWN_S] <= 0.0
            if idle and cars[i, STRUCK] == 0.0:
                decide_lane_change(cars, bodies, i, lane_y, half_width, length)
                update_bodies(cars, bodies, half_length, half_width)
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
        wish = following_acceleration(
            bodies, i, cars[i, S], speed, desired, right, left, half_length, length
        )
        # The limits decrease at most at comfortable braking, so the car can keep to them.
        cars[i, SPEED] = min(max(speed + wish * dt, 0.0), limit)
        distance = 0.5 * (speed + cars[i, SPEED]) * dt
        move_car(cars, i, centre_line_advance(table, cars[i, S], cars[i, Y], distance), dt, length)
    update_bodies(cars, bodies, half_length, half_width)


@compiled
def update_poses(cars: FloatArray, table: FloatArray, poses: FloatArray) -> None:
    """Fill `poses` (n, 6): x, y, z, roll, pitch, yaw of the ground point under each car (m, rad).

    The angles are PyBullet's (R = Rz(yaw) Ry(pitch) Rx(roll), pitch positive nose down); the car's
    up axis is the road normal. Poses of struck cars are not changed.
    """
    for i in range(cars.shape[0]):
        if cars[i, STRUCK] > 0.0:
            continue
        s, y = cars[i, S], cars[i, Y]
        index = piece_table.index_at(table, s)
        x0, y0, _, heading, _ = piece_table.pose_at(table, s)
        z, nx, ny, nz = piece_table.surface(table, index, s, y)
        sideways = 0.0
        if cars[i, CHANGE_PROGRESS] < 1.0:
            done = cars[i, CHANGE_PROGRESS]
            slope = 30.0 * done**2 * (1.0 - done) ** 2 / cars[i, CHANGE_LENGTH_M]
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
def limit_deceleration(squared: FloatArray, gain: float) -> None:
    """Lower squared speed limits (n,) (m2/s2) of equal cells round the lap, in place, so that the
    limit of a cell exceeds the limit of the next by at most `gain`. A car that brakes with `gain` /
    (2 x length of a cell) in m/s2 can then keep to them."""
    cells = squared.shape[0]
    for cell in range(2 * cells - 1, -1, -1):  # two laps, because the cells form a loop
        ahead = squared[(cell + 1) % cells] + gain
        squared[cell % cells] = min(squared[cell % cells], ahead)
