"""Tyre force from slip and load, with the friction ellipse; wheel frame x along it, y to its left.

The magic formula and the load's effect as TORCS's car has them, so that its laps are driven here.
"""

import math
from typing import Any

from runtime.jit import compiled

SLOWEST_M_S = 4.0
"""Slip is measured against at least this speed, so that a standing tyre acts as a damper and the
200 Hz integration stays stable (a stiff tyre's rate grows as one over the speed)."""


@compiled
def slip_force_ratio(
    slip: float, peak: float, stiffness: float, shape: float, curvature: float
) -> float:
    """Force per unit of combined slip (N): the secant of the magic formula at `slip`.

    F = D sin(C atan(B s - E (B s - atan(B s)))) with D = `peak` and B C = `stiffness` (Pacejka,
    Tyre and Vehicle Dynamics, eq. 4.49). The force of combined slip points along the slip (the
    similarity method), so its components trace the friction ellipse.
    """
    if slip < 1e-9:
        return stiffness * peak
    straight = stiffness / shape * slip
    bent = (1.0 - curvature) * straight + curvature * math.atan(straight)
    return peak * math.sin(shape * math.atan(bent)) / slip


@compiled
def peak_force(p: Any, front: bool, load: float, grip: float) -> float:
    """Largest force (N) of a tyre pressed down by `load` (N): the friction falls with the load."""
    share = load / (p.working_front if front else p.working_rear)
    spread = p.friction_unloaded - p.friction_overloaded
    rate = math.log((1.0 - p.friction_overloaded) / spread)  # nominal friction at share 1
    friction = p.friction * (p.friction_overloaded + spread * math.exp(rate * share))
    gain = p.camber_gain_front if front else p.camber_gain_rear
    return float(friction * gain * grip * load)


@compiled
def tyre_grip(p: Any, peak: float, along: float, across: float, spin: float) -> float:
    """Tyre force (N) for each m/s of slip speed, at the present combined slip.

    along, across: ground speed in the wheel's frame (m/s); spin: of the wheel (rad/s).
    """
    reference = max(abs(along), SLOWEST_M_S)
    slip = math.hypot(spin * p.wheel_radius - along, across) / reference
    ratio = slip_force_ratio(slip, peak, p.tyre_stiffness, p.tyre_shape, p.tyre_curvature)
    return ratio / reference
