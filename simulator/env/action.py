"""Actions of the environments: the steering alone, or the paper's four commands."""

from typing import Any, Literal

import gymnasium as gym
import numpy as np

from simulator.bounds import clip_rounding
from simulator.vehicle.car import HIGHEST_GEAR, LOWEST_GEAR
from simulator.vehicle.state import Command
from trackfeatures.errors import UserError

Controls = Literal["steer", "full"]

THROTTLE, GEAR = 0.2, 1
"""Throttle and gear that are held while only the steering is controlled, as in the paper."""

LIMITS = {
    "steer": (-1.0, 1.0),
    "throttle": (0.0, 1.0),
    "brake": (0.0, 1.0),
    "gear": (float(LOWEST_GEAR), float(HIGHEST_GEAR)),
}
NAMES: dict[str, tuple[str, ...]] = {"steer": ("steer",), "full": tuple(LIMITS)}


def check_controls(controls: str) -> None:
    """Raises UserError unless `controls` is one of NAMES."""
    if controls not in NAMES:
        raise UserError(f'controls is {controls!r}; choose "steer" or "full"')


def action_space(controls: Controls) -> gym.spaces.Box:
    """(1,) steering, or (4,) steering, throttle, brake and gear; float32."""
    low, high = zip(*(LIMITS[name] for name in NAMES[controls]), strict=True)
    return gym.spaces.Box(np.array(low, np.float32), np.array(high, np.float32))


def to_command(action: Any, controls: Controls) -> Command:
    """The command for `action`; the gear is rounded. Values that exceed their bounds by the
    rounding of float32 are clipped. Raises UserError for values further outside the space."""
    names = NAMES[controls]
    try:
        values = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError) as error:  # torch raises RuntimeError
        raise UserError(f"the action {action!r} is no array of numbers: {error}") from error
    if values.shape != (len(names),):
        raise UserError(
            f"the action is {action!r}; give {len(names)} number(s), shape ({len(names)},): "
            f"{', '.join(names)}"
        )
    numbers = values.tolist()
    for k, name in enumerate(names):
        low, high = LIMITS[name]
        if not low <= numbers[k] <= high:  # false for NaN too
            numbers[k] = _clip(name, numbers[k], low, high)
    if controls == "steer":
        return Command(steer=numbers[0], throttle=THROTTLE, gear=GEAR)
    steer, throttle, brake, gear = numbers
    return Command(steer=steer, throttle=throttle, brake=brake, gear=round(gear))


def _clip(name: str, value: float, low: float, high: float) -> float:
    clipped = clip_rounding(value, low, high)
    if not low <= clipped <= high:
        raise UserError(
            f"the action has {name} = {value:.9g}; give a finite number from {low:g} to {high:g} "
            "(gymnasium.wrappers.ClipAction clips for you)"
        )
    return clipped
