"""Car dynamics against closed forms: rolling, static loads, cornering, braking, engine."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from simulator.track.pieces import Piece
from simulator.track.road import Road
from simulator.vehicle.car import GRAVITY, RPM, CarParameters
from simulator.vehicle.dynamics import DT, MEMORY, MOTION, PIECE, compute_forces
from simulator.vehicle.powertrain import clutch
from simulator.vehicle.state import CarState, Command
from simulator.vehicle.surface import SURFACES, VERGE, ground
from simulator.vehicle.tyre import peak_force
from simulator.vehicle.wheels import wheel_angle
from simulator.world.world import World
from tests.simulator.track.track_samples import build
from trackfeatures.errors import UserError

CAR = CarParameters()
# A car without air drag and rolling resistance.
FREE = replace(CAR, rolling_resistance=0.0, drag_coefficient=0.0, wing_drag=0.0)
NEUTRAL = Command(gear=0)
ASPHALT = SURFACES["asphalt"].grip


def plain(grade: float = 0.0, width: float = 600.0) -> Road:
    """A loop so wide that its first straight (1500 m, rising by `grade`) is an open plane."""
    rise = 1500.0 * grade
    bend = math.pi * 400.0
    pieces = [
        Piece(1500.0, 0.0, 0.0, 0.0, rise, rise),
        Piece(bend, 1 / 400.0, rise, rise, rise, rise),
        Piece(1500.0, 0.0, rise, rise, 0.0, 0.0),
        Piece(bend, 1 / 400.0, 0.0, 0.0, 0.0, 0.0),
    ]
    return Road(build(pieces, width))


def drive(
    car: CarParameters,
    seconds: float,
    command: Callable[[CarState], Command],
    *,
    speed: float = 0.0,
    grade: float = 0.0,
    s: float = 300.0,
) -> list[CarState]:
    with World(plain(grade), car=car) as world:
        states = [world.reset(seed=0, s=s, speed=speed)]
        for _ in range(round(20 * seconds)):
            states.append(world.step(command(states[-1])))
    return states


def test_20_m_s_for_2_s_is_40_m() -> None:
    end = drive(FREE, 2.0, lambda _: NEUTRAL, speed=20.0)[-1]
    assert end.s - 300.0 == pytest.approx(40.0, abs=0.01)
    assert end.odometer_m == pytest.approx(40.0, abs=0.01)
    assert end.to_middle == pytest.approx(0.0, abs=1e-6)
    assert end.speed_kmh == pytest.approx(72.0, abs=0.02)


def test_a_coasting_car_conserves_energy_up_a_hill() -> None:
    grade = 0.05
    states = drive(FREE, 4.0, lambda _: NEUTRAL, speed=20.0, grade=grade)
    # The rotating wheels store energy, too: each adds J / r^2 to the mass.
    inertia = FREE.total_mass + 4 * FREE.wheel_inertia / FREE.wheel_radius**2
    slope = math.atan(grade)
    expected = 20.0 - FREE.total_mass * GRAVITY * math.sin(slope) / inertia * 4.0
    assert states[-1].speed == pytest.approx(expected, abs=0.03)
    assert states[-1].pitch == pytest.approx(-slope, abs=0.002)  # nose up is negative


def test_static_loads_balance_weight_and_moments() -> None:
    front, rear = CAR.static_loads
    assert 2 * (front + rear) == pytest.approx(CAR.total_mass * GRAVITY)
    assert front * CAR.front_axle == pytest.approx(rear * CAR.rear_axle)
    motion, memory = np.zeros(MOTION), np.zeros(MEMORY)
    motion[0], motion[2], motion[6] = 300.0, CAR.cg_height, 1.0
    memory[PIECE] = -1
    road, wrench = plain(), np.ones(6)
    table, command = road.track.arrays(), np.zeros(4)
    compute_forces(CAR.packed(), table, ground(road), motion, memory, command, wrench)
    np.testing.assert_allclose(wrench, 0.0, atol=1e-6)


def test_at_rest_the_car_stays_where_it_is() -> None:
    end = drive(CAR, 5.0, lambda _: Command(brake=1.0))[-1]
    assert (end.z, end.roll, end.pitch) == pytest.approx((CAR.cg_height, 0.0, 0.0), abs=1e-6)
    assert abs(end.speed) < 1e-6
    assert end.rpm == CAR.idle_rpm


@pytest.mark.parametrize("speed", [10.0, 15.0, 20.0, 25.0, 30.0])
def test_steady_cornering_follows_the_bicycle_model(speed: float) -> None:
    """Yaw rate = v delta / (L + K v^2) (Rajamani, Vehicle Dynamics and Control, 3.3)."""
    delta = 0.005  # small, as the model is linear

    def hold(state: CarState) -> Command:
        throttle = min(max(0.1 + 0.5 * (speed - state.vx), 0.0), 1.0)
        return Command(steer=delta / CAR.steering_lock, throttle=throttle, gear=2)

    # Steady long before the car reaches the verge.
    states = drive(replace(FREE, lift_front=0.0, lift_rear=0.0), 1.5, hold, speed=speed)
    turn = float(np.mean([state.yaw_rate for state in states[-10:]]))
    v = float(np.mean([state.vx for state in states[-10:]]))
    front, rear = CAR.cornering_stiffness(True, ASPHALT), CAR.cornering_stiffness(False, ASPHALT)
    gradient = CAR.rear_axle / (2 * front) - CAR.front_axle / (2 * rear)
    gradient *= CAR.total_mass / CAR.wheelbase
    assert turn == pytest.approx(v * delta / (CAR.wheelbase + gradient * v * v), rel=0.03)
    assert states[-1].angle < 0.0  # it turned left, so it points to the left of the track
    # Slip angle at the centre of gravity: the rear axle's share of the bicycle model.
    rear_slip = CAR.total_mass * v * turn * CAR.front_axle / CAR.wheelbase
    rear_slip /= 2 * rear
    side_slip = float(np.mean([state.vy / state.vx for state in states[-10:]]))
    assert side_slip == pytest.approx(CAR.rear_axle * turn / v - rear_slip, abs=0.0015)


def test_cornering_loads_the_outer_wheels() -> None:
    states = drive(CAR, 3.0, lambda _: Command(steer=0.2, throttle=0.2), speed=18.0)
    assert states[-1].yaw_rate > 0.1
    assert states[-1].roll > 0.005  # leans to the right, out of the left-hand bend
    left, right = states[-1].wheel_spin[0], states[-1].wheel_spin[1]
    assert right > left * 1.02


def test_braking_is_limited_by_friction() -> None:
    states = drive(CAR, 1.0, lambda _: Command(brake=1.0, gear=0), speed=30.0)
    slowest = (30.0 - states[-1].speed) / 1.0
    limit = CAR.friction * ASPHALT * GRAVITY
    # Drag and wings add a little to the tyres' braking; locked tyres brake a little less.
    assert 0.6 * limit < slowest < 1.15 * limit
    assert states[-1].pitch > 0.002  # the nose dips
    gentle = drive(CAR, 1.0, lambda _: Command(brake=0.1, gear=0), speed=30.0)
    force = 0.1 * CAR.brake_torque / CAR.wheel_radius
    inertia = CAR.total_mass + 4 * CAR.wheel_inertia / CAR.wheel_radius**2
    assert (30.0 - gentle[-1].speed) == pytest.approx(force / inertia, abs=0.6)


def test_steering_is_limited_by_its_rate() -> None:
    states = drive(CAR, 0.1, lambda _: Command(steer=1.0))
    per_step = CAR.steering_rate * 0.05 / CAR.steering_lock
    assert states[1].steer == pytest.approx(per_step, rel=1e-6)
    assert states[2].steer == pytest.approx(1.0)


def test_throttle_0_2_in_gear_1_gives_the_papers_speed_on_a_flat_road() -> None:
    start = drive(CAR, 30.0, lambda _: Command(throttle=0.2))
    assert 60.0 < start[-1].speed_kmh < 75.0
    assert start[-1].rpm == pytest.approx(394.0 * start[-1].vx, rel=0.003)  # as in TORCS's drives
    downhill = drive(CAR, 25.0, lambda _: Command(throttle=0.2), speed=18.0, grade=-0.05)
    assert 65.0 < downhill[-1].speed_kmh < 85.0  # the engine brakes


# Acceleration plus g times slope (m/s2) in the real TORCS, medians by speed (m/s) over a lap with a
# long descent: gear 1, throttle 0.2. The limiter is at 23.3 m/s.
FORCE_IN_TORCS = {18: 0.0, 19: -0.31, 20: -0.49, 21: -0.63, 22: -0.80, 23: -0.39, 24: -0.43}


def test_the_longitudinal_force_by_speed_is_that_of_torcs() -> None:
    grade = -0.12
    rolling = Command(throttle=0.2)
    states = drive(CAR, 12.0, lambda _: rolling, speed=17.5, grade=grade)
    speed = np.array([state.speed for state in states])
    force = np.gradient(speed, 0.05) + GRAVITY * math.sin(math.atan(grade))
    settled = np.arange(len(speed)) > 10  # the springs' swing at the start
    for low, expected in FORCE_IN_TORCS.items():
        here = settled & (speed >= low) & (speed < low + 1)
        if low == 23:
            here &= speed > 23.35  # above the limiter only, as most of that lap's steps
        assert np.median(force[here]) == pytest.approx(expected, abs=0.12), low


def test_the_engine_is_held_at_its_top_speed_in_gear() -> None:
    states = drive(CAR, 20.0, lambda _: Command(throttle=0.2), speed=22.0, grade=-0.12)
    fastest = CAR.top_rpm / 394.0  # m/s in gear 1
    assert max(state.rpm for state in states) == pytest.approx(CAR.top_rpm)
    # The slip of the tyres holds the car against the slope, a little above the wheels' speed.
    assert states[-1].speed == pytest.approx(fastest, abs=0.6)
    assert all(state.rpm <= CAR.top_rpm + 1e-6 for state in states)


@pytest.mark.parametrize("throttle", [0.0, 0.2, 1.0])
def test_there_is_no_torque_in_gear_above_the_limiter(throttle: float) -> None:
    p = CAR.packed()[0]
    assert clutch(p, (CAR.limiter_rpm + 1.0) / RPM, throttle)[1] == 0.0
    assert clutch(p, (CAR.limiter_rpm - 1.0) / RPM, throttle)[1] != 0.0


def test_in_neutral_the_engine_falls_from_the_limiter() -> None:
    states = drive(CAR, 2.0, lambda state: Command(throttle=1.0 if state.time_s < 1 else 0, gear=0))
    assert max(state.rpm for state in states) > 0.95 * CAR.limiter_rpm
    assert states[-1].rpm < 0.8 * CAR.limiter_rpm


def test_reverse_gear_and_gear_range() -> None:
    end = drive(CAR, 3.0, lambda _: Command(throttle=0.5, gear=-1))[-1]
    assert end.speed < -1.0
    assert end.backwards
    with pytest.raises(UserError, match="gear = 7"):
        drive(CAR, 1.0, lambda _: Command(gear=7))


def test_bad_car_parameters_are_refused() -> None:
    with pytest.raises(UserError, match="mass is -1"):
        CarParameters(mass=-1.0)
    with pytest.raises(UserError, match="torque table has 2"):
        CarParameters(torque=(1.0, 2.0))


def test_physics_step_is_five_milliseconds() -> None:
    assert DT == 0.005


def test_tyre_stiffness_matches_the_recorded_laps() -> None:
    # Fitted to yaw rate and side slip of TORCS's laps: 120 to 130 kN/rad, front and rear alike.
    for front in (True, False):
        assert 115e3 < CAR.cornering_stiffness(front, ASPHALT) < 135e3


def test_tyre_friction_falls_with_load() -> None:
    p = CAR.packed()[0]
    light, heavy = peak_force(p, True, 2000.0, ASPHALT), peak_force(p, True, 6000.0, ASPHALT)
    assert light < heavy < 3.0 * light
    nominal = peak_force(p, True, float(p["working_front"]), 1.0)
    assert nominal == pytest.approx(CAR.friction * CAR.camber_gain_front * p["working_front"])


def test_ackermann_steering_of_the_inner_wheel() -> None:
    p = CAR.packed()[0]
    for sign in (1.0, -1.0):
        left, right = wheel_angle(p, 0, 0.3 * sign), wheel_angle(p, 1, 0.3 * sign)
        inner, outer = (left, right) if sign > 0 else (right, left)
        assert inner == pytest.approx(0.3 * sign)
        # Both are square to circles about one centre, on the line of the rear axle.
        radius = CAR.wheelbase / math.tan(0.3)
        track = 0.5 * (CAR.front_track + CAR.rear_track)
        assert outer == pytest.approx(sign * math.atan2(CAR.wheelbase, radius + track))
    assert wheel_angle(p, 2, 0.3) == 0.0


def test_the_verge_has_less_grip_and_more_rolling_resistance() -> None:
    """One lane on a track 16 m wide: asphalt to 3 m, then verge."""
    road = plain(width=16.0)
    slowed = {}
    for name, to_middle in (("road", 0.0), ("half", 3.0), ("verge", 5.5)):
        with World(road) as world:
            world.reset(seed=0, s=300.0, to_middle=to_middle, speed=20.0)
            braked = [world.step(Command(brake=1.0, gear=0)) for _ in range(16)]
            slowed[name] = 20.0 - braked[-1].speed
            slowed[name + " yaw"] = abs(braked[4].yaw_rate)
    assert slowed["verge"] / slowed["road"] == pytest.approx(VERGE.grip / ASPHALT, abs=0.05)
    assert slowed["verge"] < slowed["half"] < slowed["road"]
    # With its left wheels on the verge, the car is pulled round by the right ones.
    assert slowed["half yaw"] > 0.2
    assert slowed["road yaw"] == pytest.approx(0.0, abs=1e-6)
    rolled = {}
    for to_middle in (0.0, 5.5):
        with World(road) as world:
            world.reset(seed=0, s=300.0, to_middle=to_middle, speed=5.0)
            rolled[to_middle] = 5.0 - [world.step(NEUTRAL) for _ in range(40)][-1].speed
    more = CAR.rolling_resistance * (VERGE.rolling - 1.0) * GRAVITY * 2.0
    assert rolled[5.5] - rolled[0.0] == pytest.approx(more, rel=0.15)
