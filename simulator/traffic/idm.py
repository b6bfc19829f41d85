"""The intelligent driver model (IDM): acceleration from speed, desired speed and gap. SI units.

Source: Treiber, Hennecke, Helbing, "Congested traffic states in empirical observations and
microscopic simulations", Physical Review E 62 (2000). Traffic and the scripted driver of `datagen`
use it.
"""

import math

from runtime.jit import compiled

TIME_HEADWAY_S = 1.4
STANDSTILL_GAP_M = 2.5
COMFORTABLE_ACCELERATION = 1.4  # m/s2
COMFORTABLE_BRAKING = 2.0  # m/s2
MAX_BRAKING = 9.0  # m/s2: the limit on dry asphalt; the IDM itself has no limit
_MIN_GAP_M = 0.1  # the model divides by the gap
_MIN_DESIRED_SPEED = 0.1  # m/s; the model divides by the desired speed


@compiled
def idm_acceleration(gap: float, speed: float, lead_speed: float, desired_speed: float) -> float:
    """Return the acceleration (m/s2) of a driver `gap` m (bumper to bumper) behind a leader.

    `gap` is math.inf if there is no leader. All speeds are in m/s. Unlike in Treiber's model,
    braking to the desired speed is limited to 2 m/s2; only a leader can cause harder braking.
    """
    free = 1.0 - (speed / max(desired_speed, _MIN_DESIRED_SPEED)) ** 4
    free = max(COMFORTABLE_ACCELERATION * free, -COMFORTABLE_BRAKING)
    if math.isinf(gap):
        return free
    closing = speed * (speed - lead_speed)
    closing /= 2.0 * math.sqrt(COMFORTABLE_ACCELERATION * COMFORTABLE_BRAKING)
    desired_gap = STANDSTILL_GAP_M + max(speed * TIME_HEADWAY_S + closing, 0.0)
    interaction = COMFORTABLE_ACCELERATION * (desired_gap / max(gap, _MIN_GAP_M)) ** 2
    return max(free - interaction, -MAX_BRAKING)
