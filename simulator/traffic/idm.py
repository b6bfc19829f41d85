"""How a driver keeps speed and distance: the intelligent driver model, in SI units.

Treiber, Hennecke, Helbing, "Congested traffic states in empirical observations and microscopic
simulations", Physical Review E 62 (2000). Traffic and the scripted driver of `datagen` share it.
"""

import math

from runtime.jit import compiled

TIME_HEADWAY_S = 1.4
STANDSTILL_GAP_M = 2.5
COMFORTABLE_ACCELERATION = 1.4  # m/s2
COMFORTABLE_BRAKING = 2.0  # m/s2
HARDEST_BRAKING = 9.0  # m/s2: what dry asphalt gives; the model alone would ask for any amount
_CLOSEST_GAP_M = 0.1  # the model divides by the gap
_SLOWEST_WISH = 0.1  # m/s: and by the desired speed


@compiled
def idm_acceleration(gap: float, speed: float, lead_speed: float, desired_speed: float) -> float:
    """Acceleration (m/s2) of a driver `gap` m (bumper to bumper) behind a leader.

    `gap` is math.inf on a free road. Speeds in m/s. A driver above the desired speed slows down no
    harder than is comfortable (the original would brake hard); the leader alone can ask for more.
    """
    free = 1.0 - (speed / max(desired_speed, _SLOWEST_WISH)) ** 4
    free = max(COMFORTABLE_ACCELERATION * free, -COMFORTABLE_BRAKING)
    if math.isinf(gap):
        return free
    closing = speed * (speed - lead_speed)
    closing /= 2.0 * math.sqrt(COMFORTABLE_ACCELERATION * COMFORTABLE_BRAKING)
    wanted = STANDSTILL_GAP_M + max(speed * TIME_HEADWAY_S + closing, 0.0)
    pressed = COMFORTABLE_ACCELERATION * (wanted / max(gap, _CLOSEST_GAP_M)) ** 2
    return max(free - pressed, -HARDEST_BRAKING)
