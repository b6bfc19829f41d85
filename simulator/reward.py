"""The reward of the paper (section on the RL control module): heading and place on the track."""

import math

OFF_TRACK_REWARD = -2.0


def step_reward(
    angle: float,
    to_middle: float,
    half_width: float,
    off_track: bool,
    backwards: bool,
    weight: float = 1.0,
) -> float:
    """cos(angle) - weight |sin(angle)| - |to_middle| / half_width, or -2 when the episode ends.

    angle in rad, to_middle and half_width (half of the track's own width) in m. A score is the
    sum over a fixed number of steps.
    """
    if off_track or backwards or abs(angle) >= 0.5 * math.pi:
        return OFF_TRACK_REWARD
    return math.cos(angle) - weight * abs(math.sin(angle)) - abs(to_middle) / half_width
