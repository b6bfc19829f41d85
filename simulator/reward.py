"""The reward of the paper (section on the RL control module): heading and place on the track."""

import math
from typing import Literal

from simulator.state import CarState

Ending = Literal["off_track", "backwards", "collision"]

OFF_TRACK_REWARD = -2.0


def ending(state: CarState) -> Ending | None:
    """Why a drive ends at `state`, None while it goes on; the rails belong to leaving the track."""
    # Walls stand 2.5 m beyond the edge, so that the car is off the track before it meets one; it
    # stays so where the blow throws it back onto the road within the same control step.
    if state.off_track or state.collision == "wall":
        return "off_track"
    if state.backwards:
        return "backwards"
    return "collision" if state.collision == "traffic" else None


def step_reward(
    angle: float,
    to_middle: float,
    half_width: float,
    ended: bool,
    weight: float = 1.0,
) -> float:
    """cos(angle) - weight |sin(angle)| - |to_middle| / half_width, or -2 when the episode ends.

    angle in rad, to_middle and half_width (half of the track's own width) in m. A score is the
    sum over a fixed number of steps.
    """
    if ended or abs(angle) >= 0.5 * math.pi:
        return OFF_TRACK_REWARD
    return math.cos(angle) - weight * abs(math.sin(angle)) - abs(to_middle) / half_width
