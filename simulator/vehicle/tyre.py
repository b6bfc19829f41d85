"""Tyre force from slip and load, with the friction ellipse. Wheel frame: x forward, y left.

The magic formula and the effect of the load are the same as in TORCS's car model. `p` is the record
`CarParameters.packed()[0]`.
"""

import math
from typing import Any

from runtime.jit import inlined

MIN_SLIP_SPEED_M_S = 4.0
"""Least reference speed (m/s) of the slip. Because of it, a tyre at rest acts as a damper, and the
200 Hz integration stays stable (the rate of a stiff tyre is proportional to 1 / speed)."""


@inlined
def slip_force_ratio(
    slip: float, peak: float, stiffness: float, slope: float, shape: float, curvature: float
) -> float:
    """Return the tyre force per unit of combined slip (N): the secant of the magic formula at
    `slip`.

    F = D sin(C atan(B s - E (B s - atan(B s)))) with B = `slope`, C = `shape`, D = `peak` (N), E =
    `curvature` and B C = `stiffness` (Pacejka, Tyre and Vehicle Dynamics, eq. 4.49). The force
    points along the combined slip (similarity method), so its components lie on the friction
    ellipse.
    """
    if slip < 1e-9:
        return stiffness * peak
    linear = slope * slip
    argument = (1.0 - curvature) * linear + curvature * math.atan(linear)
    return peak * math.sin(shape * math.atan(argument)) / slip


@inlined
def peak_force(p: Any, front: bool, load: float, grip: float) -> float:
    """Return the largest force (N) of a front (`front`) or rear tyre at `load` (N) on ground with
    the factor `grip` on the friction coefficient. The friction coefficient decreases with the
    load."""
    share = load / (p.working_front if front else p.working_rear)
    span = p.friction_unloaded - p.friction_overloaded
    # The value of `friction_rate` gives the nominal friction at share 1.
    friction = p.friction * (p.friction_overloaded + span * math.exp(p.friction_rate * share))
    gain = p.camber_gain_front if front else p.camber_gain_rear
    return float(friction * gain * grip * load)


@inlined
def tyre_slip_gain(p: Any, peak: float, along: float, across: float, spin: float) -> float:
    """Return the tyre force per m/s of slip speed (N s/m) at the current combined slip.

    peak: largest tyre force (N); along, across: speed over the ground in the wheel frame (m/s);
    spin: wheel speed (rad/s).
    """
    reference = max(abs(along), MIN_SLIP_SPEED_M_S)
    slip = math.hypot(spin * p.wheel_radius - along, across) / reference
    ratio = slip_force_ratio(
        slip, peak, p.tyre_stiffness, p.tyre_slope, p.tyre_shape, p.tyre_curvature
    )
    return ratio / reference
