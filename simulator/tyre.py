"""Tyre force from slip, with the friction ellipse; wheel frame x along the wheel, y to its left."""

import math

from simulator.compiled import compiled

SLOWEST_M_S = 2.0
"""Slip is measured against at least this speed, so that a standing tyre acts as a damper and the
200 Hz integration stays stable (a stiff tyre's rate grows as one over the speed)."""


@compiled
def slip_force_ratio(
    slip: float, load: float, stiffness: float, friction: float, shape: float
) -> float:
    """Force per unit of combined slip (N): the secant of the magic formula at `slip`.

    F = D sin(C atan(B slip)) with D = friction * load and B C D = stiffness (Pacejka, Tyre and
    Vehicle Dynamics, eq. 4.49 with E = 0). The force of combined slip points along the slip (the
    similarity method), so its components trace the friction ellipse.
    """
    peak = friction * load
    if peak <= 0.0:
        return 0.0
    sharpness = stiffness / (shape * peak)
    if slip < 1e-9:
        return stiffness
    return peak * math.sin(shape * math.atan(sharpness * slip)) / slip
