"""The controllers by name. To add one: a new file with a class that has `update`, one line here."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from controllers.interface import Controller
from controllers.lqr import WEIGHTS_EXACT, WEIGHTS_PERCEIVED, Lqr
from controllers.rl.actor import is_actor
from controllers.rl.controller import load_controller, shipped_controller
from controllers.torcs_feedback import StateFeedback
from trackfeatures.errors import UserError


@dataclass(frozen=True)
class LoopConfig:
    """The control loop that a controller is made for."""

    dt: float
    """s between two control steps."""
    noisy: bool = False
    """Whether the state is estimated by a perception, with errors, or exact."""


CONTROLLERS: dict[str, Callable[[LoopConfig], Controller]] = {
    "lqr": lambda loop: Lqr(loop.dt, WEIGHTS_PERCEIVED if loop.noisy else WEIGHTS_EXACT),
    "torcs": lambda loop: StateFeedback(),
    "rl": lambda loop: shipped_controller("rl"),
}


def make_controller(name: str, loop: LoopConfig) -> Controller:
    """The controller `name`, or the trained actor in the folder `name`. Raises UserError where
    there is none of that name."""
    if name not in CONTROLLERS and is_actor(Path(name)):
        return load_controller(Path(name))
    if name not in CONTROLLERS:
        raise UserError(f"there is no controller {name!r}; use one of: {', '.join(CONTROLLERS)}")
    return CONTROLLERS[name](loop)
