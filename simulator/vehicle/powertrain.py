"""Engine, gearbox and clutch: computes torques (N m) from speeds (rad/s) and throttle. `p` is the
record `CarParameters.packed()[0]`."""

from typing import Any

from runtime.jit import compiled, inlined
from simulator.vehicle.car import RPM, TORQUE_RPM_STEP


@inlined
def gear_ratio(p: Any, gear: int) -> float:
    """Return the ratio of engine speed to rear-wheel speed in `gear` (-1 to 6). It is negative in
    reverse (-1) and 0 in neutral (0)."""
    if gear > 0:
        return float(p.gears[gear - 1] * p.final_drive)
    if gear < 0:
        return float(p.reverse_gear * p.final_drive)
    return 0.0


@inlined
def engine_torque(p: Any, speed: float, throttle: float) -> float:
    """Return the torque (N m) at the crankshaft at `speed` rad/s and `throttle` (0 to 1).

    As in TORCS, the torque is the full-load torque times (throttle (1 + b) - b), where the engine
    braking b grows linearly from 0 at idle. The formula reproduces the accelerations of recorded
    TORCS drives to 0.003 m/s2.
    """
    rpm = speed * RPM
    place = min(max(rpm / TORQUE_RPM_STEP, 0.0), 9.999)
    below = int(place)
    full = p.torque[below] + (p.torque[below + 1] - p.torque[below]) * (place - below)
    opened = 0.0 if rpm > p.limiter_rpm else throttle
    braking = p.engine_braking * max(rpm - p.idle_rpm, 0.0) / (p.top_rpm - p.idle_rpm)
    return float(full * (opened * (1.0 + braking) - braking))


@inlined
def limit_shaft_speed(p: Any, wheel_speed: float, ratio: float) -> float:
    """Return the mean speed `wheel_speed` (rad/s) of the driven wheels, limited to the speed at
    which the engine turns at `top_rpm`; `ratio` is engine speed / wheel speed.

    As in TORCS, the engine turns no faster in gear: the tyres then slip and slow the car.
    """
    top = p.top_rpm / RPM
    return float(top / ratio if wheel_speed * ratio > top else wheel_speed)


@compiled
def free_engine_speed(p: Any, speed: float, throttle: float, dt: float) -> float:
    """Return the engine speed (rad/s) after `dt` s in neutral with `throttle` (0 to 1). `speed`
    (rad/s) is the engine speed before."""
    faster = speed + dt * engine_torque(p, speed, throttle) / p.engine_inertia
    return float(min(max(faster, p.idle_rpm / RPM), p.top_rpm / RPM))


@inlined
def clutch(p: Any, shaft_speed: float, throttle: float) -> tuple[float, float, float]:
    """Return the engine speed (rad/s), and torque (N m) and inertia (kg m2) of the engine at the
    gearbox input shaft, which turns at `shaft_speed` rad/s. `throttle` is from 0 to 1.

    Below idle speed the clutch slips: the engine idles and transmits its torque, but its inertia
    does not act on the shaft. Above `limiter_rpm` the engine gives no torque, neither drive nor
    braking, as in TORCS (forces by speed: tests/simulator/vehicle/test_dynamics.py).
    """
    idle = p.idle_rpm / RPM
    if shaft_speed > p.limiter_rpm / RPM:
        return shaft_speed, 0.0, p.engine_inertia
    if shaft_speed < idle:
        return idle, engine_torque(p, idle, throttle), 0.0
    return shaft_speed, engine_torque(p, shaft_speed, throttle), p.engine_inertia
