"""Actions of the environments: steering only, or steering, throttle, brake and gear."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.bounds import clip_rounding
from simulator.vehicle.car import HIGHEST_GEAR, LOWEST_GEAR
from simulator.vehicle.state import Command
from trackfeatures.errors import UserError

Controls = Literal["steer", "full"]

THROTTLE, GEAR = 0.2, 1
"""Constant throttle and gear while only the steering is controlled; values of the paper."""

LIMITS = {
    "steer": (-1.0, 1.0),
    "throttle": (0.0, 1.0),
    "brake": (0.0, 1.0),
    "gear": (float(LOWEST_GEAR), float(HIGHEST_GEAR)),
}
NAMES: dict[str, tuple[str, ...]] = {"steer": ("steer",), "full": tuple(LIMITS)}


def check_controls(controls: str) -> None:
    """Raises UserError unless `controls` is one of NAMES."""
    if not isinstance(controls, str) or controls not in NAMES:
        raise UserError(f'controls is {controls!r}; choose "steer" or "full"')


def action_space(controls: Controls) -> gym.spaces.Box:
    """Return the action space, float32: shape (1,) for the controls "steer", or (4,) (steering,
    throttle, brake, gear) for the controls "full"."""
    low, high = zip(*(LIMITS[name] for name in NAMES[controls]), strict=True)
    return gym.spaces.Box(np.array(low, np.float32), np.array(high, np.float32))


def to_command(action: Any, controls: Controls) -> Command:
    """Convert `action`, (1,) for the controls "steer" or (4,) for "full", to a command; the gear is
    rounded. Values beyond their bounds by no more than float32 rounding are clipped. Raises
    UserError for values farther outside."""
    names = NAMES[controls]
    values = _numbers("action", action)
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


def to_rows(actions: Any, controls: Controls, moving: NDArray[np.bool_]) -> FloatArray:
    """Convert `actions`, (N, 1) for the controls "steer" or (N, 4) for "full", to rows of steer,
    throttle, brake and gear (N, 4); the gear is rounded. For (N, 1), throttle is 0.2, brake 0 and
    gear 1. Only the cars that are `moving` (N,) are checked: values beyond their bounds by no more
    than float32 rounding are clipped, values farther outside raise a UserError that names the
    car."""
    names = NAMES[controls]
    values = _numbers("actions", actions)
    if values.shape != (len(moving), len(names)):
        raise UserError(
            f"the actions have shape {values.shape}; give one row a car, shape "
            f"({len(moving)}, {len(names)}): {', '.join(names)}"
        )
    rows = np.empty((len(moving), len(LIMITS)))
    rows[:] = 0.0, THROTTLE, 0.0, GEAR
    rows[:, : len(names)] = values
    low, high = np.array([LIMITS[name] for name in names]).T
    inside = ((values >= low) & (values <= high)).all(axis=1)  # false for NaN too
    for number in np.flatnonzero(moving & ~inside).tolist():
        with naming_car(number, len(moving)):
            command = to_command(values[number], controls)
        rows[number] = command.steer, command.throttle, command.brake, command.gear
    rows[:, 3] = np.rint(rows[:, 3])
    return rows


@contextmanager
def naming_car(number: int, count: int) -> Iterator[None]:
    """Prefix the message of a UserError with the number of the car, if there are several cars
    (`count` is above 1)."""
    try:
        yield
    except UserError as error:
        if count > 1:
            error.args = (f"car {number}: {error}", *error.args[1:])
        raise


def _numbers(what: str, given: Any) -> FloatArray:
    """Return `given` as a float64 array. Raises UserError, which contains `what`, unless `given`
    consists of numbers."""
    try:
        return np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError) as error:  # torch raises RuntimeError
        raise UserError(f"the {what} {given!r} is no array of numbers: {error}") from error


def _clip(name: str, value: float, low: float, high: float) -> float:
    """Clip `value` to the bounds `low` and `high` if it exceeds one of them only by float32
    rounding. Raises UserError, which contains `name`, for a value farther outside."""
    clipped = clip_rounding(value, low, high)
    if not low <= clipped <= high:
        raise UserError(
            f"the action has {name} = {value:.9g}; give a finite number from {low:g} to {high:g} "
            "(gymnasium.wrappers.ClipAction clips for you)"
        )
    return clipped
