"""The reward of a control step, and what ends an episode.

The formula is that of the paper's section on the RL control module, with one difference: the paper
divides the lateral offset by half the width of the lane, this code by half the width of the track.
"""

import math
from collections.abc import Collection
from typing import Literal, get_args

from simulator.vehicle.state import CarState

Ending = Literal["off_track", "backwards", "collision"]

ENDINGS: tuple[Ending, ...] = get_args(Ending)
OFF_TRACK_REWARD = -2.0


def ending(state: CarState, ends: Collection[Ending] = ENDINGS) -> Ending | None:
    """Which of `ends` ends an episode at `state`, None if it goes on.

    Contact with a wall counts as "off_track"; if that is not among `ends`, as "collision".
    """
    # Walls stand 2.5 m beyond the edge, so the car is off the track before it touches one. The
    # contact counts even if the car is back on the road by the end of the same control step.
    if (state.off_track or state.collision == "wall") and "off_track" in ends:
        return "off_track"
    if state.backwards and "backwards" in ends:
        return "backwards"
    return "collision" if state.collision is not None and "collision" in ends else None


def step_reward(
    angle: float,
    to_middle: float,
    half_width: float,
    ended: bool,
    weight: float = 1.0,
) -> float:
    """cos(angle) - weight |sin(angle)| - |to_middle| / half_width, or -2 when the episode ends or
    the car points backwards (|angle| >= pi/2).

    angle in rad, to_middle and half_width (half of the track's own width) in m; weight is the
    paper's lambda. A score is the sum over a fixed number of steps.
    """
    if ended or abs(angle) >= 0.5 * math.pi:
        return OFF_TRACK_REWARD
    return math.cos(angle) - weight * abs(math.sin(angle)) - abs(to_middle) / half_width
