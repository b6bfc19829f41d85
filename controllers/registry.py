"""The controllers by name. To add one: a new file with a class that has `update`, one line here."""

from collections.abc import Callable
from dataclasses import dataclass

from controllers.interface import Controller
from controllers.lqr import EXACT, PERCEIVED, Lqr
from controllers.torcs_feedback import Feedback
from trackfeatures.errors import UserError


@dataclass(frozen=True)
class Setting:
    """What a controller is made for."""

    dt: float
    """s between two control steps."""
    perceived: bool = False
    """Whether the road is perceived, with errors, or known exactly."""


CONTROLLERS: dict[str, Callable[[Setting], Controller]] = {
    "lqr": lambda setting: Lqr(setting.dt, PERCEIVED if setting.perceived else EXACT),
    "torcs": lambda setting: Feedback(),
}
PLANNED = ("mpc", "rl")


def make_controller(name: str, setting: Setting) -> Controller:
    """Raises UserError for a name that is not there (yet)."""
    if name in CONTROLLERS:
        return CONTROLLERS[name](setting)
    there = ", ".join(CONTROLLERS)
    if name in PLANNED:
        raise UserError(f"the controller {name!r} is not there yet; use one of: {there}")
    raise UserError(f"there is no controller {name!r}; use one of: {there}")
