"""Engine, gearbox and clutch: torque from speed and throttle. rad/s and N m."""

from typing import Any

from simulator.car import RPM, TORQUE_RPM_STEP
from simulator.compiled import compiled


@compiled
def gear_ratio(p: Any, gear: int) -> float:
    """Engine turns for one turn of the rear wheels; negative in reverse, 0 in neutral."""
    if gear > 0:
        return p.gears[gear - 1] * p.final_drive
    if gear < 0:
        return p.reverse_gear * p.final_drive
    return 0.0


@compiled
def engine_torque(p: Any, speed: float, throttle: float) -> float:
    """Torque (N m) at the crankshaft at `speed` rad/s: full-load curve times throttle, less the
    engine's braking, which falls to none at wide-open throttle and at idle."""
    rpm = speed * RPM
    place = min(max(rpm / TORQUE_RPM_STEP, 0.0), 9.999)
    below = int(place)
    full = p.torque[below] + (p.torque[below + 1] - p.torque[below]) * (place - below)
    if rpm > p.limiter_rpm:
        throttle = 0.0
    drag = p.engine_brake * (rpm - p.idle_rpm) / (p.limiter_rpm - p.idle_rpm)
    return throttle * full - (1.0 - throttle) * max(drag, 0.0)


@compiled
def free_engine_speed(p: Any, speed: float, throttle: float, dt: float) -> float:
    """Speed (rad/s) after `dt` of an engine out of gear."""
    faster = speed + dt * engine_torque(p, speed, throttle) / p.engine_inertia
    return min(max(faster, p.idle_rpm / RPM), 1.05 * p.limiter_rpm / RPM)


@compiled
def clutch(p: Any, shaft_speed: float, throttle: float) -> tuple[float, float, float]:
    """What the gearbox input shaft feels at `shaft_speed` rad/s: (engine speed, torque, inertia).

    Below idle the clutch slips: the engine keeps idling, sends its torque, but not its inertia.
    """
    idle = p.idle_rpm / RPM
    if shaft_speed < idle:
        return idle, engine_torque(p, idle, throttle), 0.0
    return shaft_speed, engine_torque(p, shaft_speed, throttle), p.engine_inertia
