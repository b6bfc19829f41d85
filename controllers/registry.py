"""Makes controllers by name. To add one, write a class with `update` in `laws` and an entry here.

A user's own controller needs no entry. `MODULE:CLASS` is a class of a module that Python can
import, also from the working folder; `FILE.py:CLASS` is a class of a file.
"""

import importlib
import importlib.util
import math
import reprlib
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controllers import laws
from controllers.interface import Controller, LoopConfig, Observation, Observations
from controllers.laws.actor import CARD, SHIPPED, WEIGHTS, is_actor
from trackfeatures.errors import UserError

LAWS = Path(laws.__file__).parent
OWN_FILE = "controller_of_"
"""Prefix of the module name of a user's file, so that the file replaces no other module in
`sys.modules`."""


@dataclass(frozen=True)
class ControllerEntry:
    """A controller of this project; its module is imported when the controller is made."""

    factory: str
    """MODULE:FUNCTION; it is called with a `LoopConfig` and the given parameters by name."""
    about: str
    """A description of one line."""
    tunable: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Lowest and highest value of each parameter in the search of `controllers tune`, both above
    0."""


_LQR_WEIGHTS = {
    "offset": (0.1, 200.0),
    "offset_rate": (1e-3, 2.0),
    "heading": (0.1, 200.0),
    "heading_rate": (1e-3, 2.0),
    "rho": (1e-3, 10.0),
}
_MPC_WEIGHTS = {"offset": (0.1, 100.0), "heading": (0.1, 100.0), "wheel": (1e-3, 10.0)}

CONTROLLERS: dict[str, ControllerEntry] = {
    "lqr": ControllerEntry(
        "controllers.laws.lqr:make_lqr", "the paper's LQR: offset, angle, their rates", _LQR_WEIGHTS
    ),
    "lqr-preview": ControllerEntry(
        "controllers.laws.lqr:make_lqr_preview",
        "LQR with feed-forward of the curvature",
        _LQR_WEIGHTS,
    ),
    "lqr-paper": ControllerEntry(
        "controllers.laws.lqr:make_lqr_paper",
        "LQR as the paper's released code runs it",
        _LQR_WEIGHTS,
    ),
    "mpc": ControllerEntry(
        "controllers.laws.mpc:make_mpc", "the paper's nonlinear MPC, without preview", _MPC_WEIGHTS
    ),
    "mpc-preview": ControllerEntry(
        "controllers.laws.mpc:make_mpc_preview", "MPC that knows the curvature ahead", _MPC_WEIGHTS
    ),
    "lqr-kalman": ControllerEntry(
        "controllers.laws.kalman_control:make_lqr_kalman",
        "LQR on a filtered state, for noisy and late perception",
        _LQR_WEIGHTS | {"wheel_rate": (1e-3, 100.0)},
    ),
    "mpc-kalman": ControllerEntry(
        "controllers.laws.kalman_control:make_mpc_kalman",
        "MPC on a filtered state, for noisy and late perception",
        _MPC_WEIGHTS,
    ),
    "rl": ControllerEntry(
        "controllers.laws.rl:make_rl", "trained by reinforcement on the paper's state"
    ),
    "rl-residual": ControllerEntry(
        "controllers.laws.rl:make_rl_residual", "LQR with a learned correction"
    ),
    "torcs": ControllerEntry(
        "controllers.laws.torcs_feedback:make_torcs", "the control law of the reference laps"
    ),
}


def make_controller(
    name: str, loop: LoopConfig, parameters: Mapping[str, float] | None = None
) -> Controller:
    """Make the controller called `name`, with `parameters`.

    `name` is a key of `CONTROLLERS`, the folder of a trained actor, or a user's class. Raises
    UserError for an unknown name or parameter, a module that cannot be imported, and a class that
    cannot be made or has no method `update`.
    """
    if name not in CONTROLLERS and is_actor(Path(name)):
        from controllers.laws.rl import load_controller

        return load_controller(Path(name), loop)
    if ":" in name:
        return _make_own(name, parameters)
    if name not in CONTROLLERS:
        raise UserError(
            f"there is no controller {name!r}; use one of: {', '.join(CONTROLLERS)}, or "
            "MODULE:CLASS of your own"
        )
    entry, given = CONTROLLERS[name], dict(parameters or {})
    for parameter, value in given.items():
        if parameter not in entry.tunable:
            known = ", ".join(entry.tunable) or "none"
            raise UserError(f"{name} has no parameter {parameter!r}; it has: {known}")
        if not (math.isfinite(value) and value >= 0.0):
            raise UserError(f"{name}: {parameter} is {value}; give a finite number of 0 or more")
    module, _, function = entry.factory.partition(":")
    make: Callable[..., Controller] = getattr(importlib.import_module(module), function)
    try:
        with np.errstate(all="ignore"):
            return make(loop, **given)
    except (ValueError, np.linalg.LinAlgError) as error:
        limits = ", ".join(f"{each} {entry.tunable[each]}" for each in given)
        raise UserError(
            f"{name}: there are no gains for {given} ({error}); usual limits are {limits}"
        ) from error


def controller_code(name: str) -> bytes:
    """Return the content of the files that determine how the controller `name` steers (a name for
    `make_controller`). Raises UserError for a user's class that cannot be imported."""
    return b"".join(file.read_bytes() for file in _files_of(name))


def _files_of(name: str) -> list[Path]:
    """Return the paths of a controller's files. For a controller of this project and a trained
    actor, these are all modules of `controllers.laws` and the actor's files. For a user's class,
    these are the module in `name` and the modules that define the class and its base classes."""
    folder = SHIPPED / name if name in CONTROLLERS else Path(name)
    if name in CONTROLLERS or is_actor(folder):
        actor = [folder / part for part in (CARD, WEIGHTS)]
        return [*sorted(LAWS.glob("*.py")), *filter(Path.is_file, actor)]
    module, found = _own_class(name)
    modules = [module, *(sys.modules.get(base.__module__) for base in found.__mro__)]
    files = [getattr(one, "__file__", None) for one in modules]
    return [Path(file) for file in dict.fromkeys(files) if file is not None]


def _make_own(name: str, parameters: Mapping[str, float] | None) -> Controller:
    """Make a controller of the user's class `name`, MODULE:CLASS or FILE.py:CLASS."""
    place, _, class_name = name.rpartition(":")
    _, found = _own_class(name)
    try:
        return _OwnController(f"the class {class_name} of {place}", found(**(parameters or {})))
    except Exception as error:  # a user's class may raise anything
        raise UserError(
            f"the class {class_name} of {place} cannot be made: {_line(error)}; give every "
            "argument a default"
        ) from error


def _own_class(name: str) -> tuple[ModuleType, type]:
    """Import the user's class `name`, MODULE:CLASS or FILE.py:CLASS; return this module and the
    class."""
    place, _, class_name = name.rpartition(":")
    module = _load_file(Path(place)) if place.endswith(".py") else _import(place)
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        raise UserError(f"{place} has no class {class_name!r}; give MODULE:CLASS")
    if not callable(getattr(found, "update", None)):
        raise UserError(
            f"the class {class_name} of {place} has no method update(observation); it returns the "
            "steering action in [-1, 1], left positive"
        )
    return module, found


class _OwnController:
    """A user's controller; an error of its methods, or a wrong result, becomes a UserError."""

    def __init__(self, name: str, controller: Any) -> None:
        self._name, self._controller = name, controller
        own_batch = callable(getattr(controller, "update_batch", None))
        self.update_batch = self._update_batch if own_batch else None

    def update(self, observation: Observation) -> float:
        action = self._call("update(observation)", self._controller.update, observation)
        try:
            if math.isfinite(action):
                return float(action)
        except (TypeError, ValueError):
            pass
        raise UserError(
            f"update(observation) of {self._name} returned {action!r}; it must return the steering "
            "action, a number in [-1, 1]"
        )

    def _update_batch(self, observations: Observations) -> NDArray[np.float64]:
        what, count = "update_batch(observations)", len(observations)
        actions = self._call(what, self._controller.update_batch, observations)
        try:
            found = np.asarray(actions, np.float64)
            if found.shape == (count,):
                return found
        except (TypeError, ValueError):
            pass
        raise UserError(
            f"{what} of {self._name} returned {reprlib.repr(actions)}; it must return an array of "
            f"{count} steering actions, one for each car"
        )

    def _call(self, what: str, method: Callable[[Any], Any], argument: Any) -> Any:
        try:
            return method(argument)
        except Exception as error:  # a user's method may raise anything
            place = traceback.extract_tb(error.__traceback__)[-1]
            raise UserError(
                f"{what} of {self._name} failed: {_line(error)} "
                f"({place.filename}, line {place.lineno})"
            ) from error


def _import(name: str) -> ModuleType:
    if not name:
        raise UserError("the controller's module is missing; give MODULE:CLASS")
    folder = str(Path.cwd())
    if folder not in sys.path:  # `python -m` adds it, too
        sys.path.insert(0, folder)
    try:
        return importlib.import_module(name)
    except Exception as error:  # a user's module may raise anything
        raise UserError(f"the module {name!r} cannot be imported: {_line(error)}") from error


def _load_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise UserError(f"there is no file {path}")
    spec = importlib.util.spec_from_file_location(f"{OWN_FILE}{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    folder = str(path.parent.resolve())
    if folder not in sys.path:  # last, so that files in the folder hide no other module
        sys.path.append(folder)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look up postponed annotations there
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # a user's file may raise anything
        raise UserError(f"{path} cannot be loaded: {_line(error)}") from error
    return module


def _line(error: Any) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
