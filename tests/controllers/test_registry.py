"""The controllers by name, their parameters, and classes of a user."""

import importlib
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from controllers.interface import LoopConfig, Observation
from controllers.registry import CONTROLLERS, make_controller
from trackfeatures import RoadClass, UserError

LOOP = LoopConfig(0.05)
SEEN = Observation(0.1, 0.0, RoadClass.STRAIGHT, 15.0, 0.0, 0.0, 0.0)
OWN = """
class Good:
    def __init__(self, gain=0.2):
        self.gain = gain
    def update(self, observation):
        return -self.gain * observation.to_lane_centre

class NoUpdate:
    pass

class Needy:
    def __init__(self, something):
        pass
    def update(self, observation):
        return 0.0

class Broken:
    def __init__(self):
        raise OSError("no weights\\nhere")
    def update(self, observation):
        return 0.0

class Forgetful:
    def update(self, observation):
        observation.to_lane_centre

class Wordy:
    def update(self, observation):
        return "left"

class Unstable:
    def update(self, observation):
        return float("nan")

class Dividing:
    def update(self, observation):
        return 1 / 0

number = 3
"""
OWN_DATACLASS = """
from __future__ import annotations
from dataclasses import dataclass

@dataclass
class Law:
    gain: float = 0.2
    def update(self, observation):
        return -self.gain * observation.to_lane_centre
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, which contains a user's modules."""
    (tmp_path / "own_law.py").write_text(OWN)
    (tmp_path / "own_broken.py").write_text("import no_such_package\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*__import__("sys").path])
    return tmp_path


def oscillation() -> list[Observation]:
    """A second and a half of a car that turns to and fro once a second: the delay is plain."""
    omega = 2.0 * math.pi
    return [
        replace(
            SEEN, angle=-0.05 * math.sin(omega * t), yaw_rate=0.05 * omega * math.cos(omega * t)
        )
        for t in (LOOP.dt * step for step in range(60))
    ]


@pytest.mark.parametrize("name", list(CONTROLLERS))
def test_every_parameter_can_be_set_and_changes_the_steering(name: str) -> None:
    for parameter, (low, high) in CONTROLLERS[name].tunable.items():
        assert 0.0 < low < high
        soft, hard = (
            [controller.update(seen) for seen in oscillation()]
            for controller in (make_controller(name, LOOP, {parameter: v}) for v in (low, high))
        )
        assert soft[-1] != hard[-1], parameter


def test_an_unknown_parameter_or_value_is_refused() -> None:
    with pytest.raises(UserError, match="lqr has no parameter 'gain'; it has: offset"):
        make_controller("lqr", LOOP, {"gain": 1.0})
    with pytest.raises(UserError, match="rho is nan"):
        make_controller("lqr", LOOP, {"rho": float("nan")})
    with pytest.raises(UserError, match="torcs has no parameter 'gain'; it has: none"):
        make_controller("torcs", LOOP, {"gain": 1.0})


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("lqr", {"offset": 1e300}),
        ("lqr-paper", {"rho": 0.0}),
        ("lqr-kalman", {"wheel_rate": 1e300}),
        ("lqr-kalman", dict.fromkeys(CONTROLLERS["lqr-kalman"].tunable, 0.0)),
    ],
)
def test_parameters_without_gains_are_refused(name: str, parameters: dict[str, float]) -> None:
    with pytest.raises(UserError, match=rf"^{name}: there are no gains for .*; usual limits are"):
        make_controller(name, LOOP, parameters)


@pytest.mark.parametrize("name", ["pid", "LQR", ""])
def test_an_unknown_controller_is_refused_with_the_known_names(name: str) -> None:
    with pytest.raises(UserError, match=f"no controller '{name}'; use one of: lqr, lqr-preview"):
        make_controller(name, LOOP)


@pytest.mark.parametrize("name", ["own_law:Good", "own_law.py:Good"])
def test_a_users_class_is_made(own: Path, name: str) -> None:
    assert make_controller(name, LOOP).update(SEEN) == pytest.approx(-0.02)
    assert make_controller(name, LOOP, {"gain": 1.0}).update(SEEN) == pytest.approx(-0.1)


@pytest.mark.parametrize("name", ["own_data", "json"])  # a file hides no module of its name
def test_a_users_file_may_hold_a_dataclass_with_postponed_annotations(own: Path, name: str) -> None:
    (own / f"{name}.py").write_text(OWN_DATACLASS)
    assert make_controller(f"{name}.py:Law", LOOP).update(SEEN) == pytest.approx(-0.02)
    assert importlib.import_module("json").loads("1") == 1


def test_a_users_file_may_import_a_module_beside_it(own: Path) -> None:
    folder = own / "laws"
    folder.mkdir()
    (folder / "gain_beside.py").write_text("GAIN = 0.5\n")
    (folder / "law.py").write_text(
        "from gain_beside import GAIN\n\n"
        "class Law:\n    def update(self, observation):\n        return GAIN\n"
    )
    for _ in range(2):
        assert make_controller("laws/law.py:Law", LOOP).update(SEEN) == 0.5
    assert sys.path.count(str(folder)) == 1
    assert sys.path[-1] == str(folder)  # last: the files in the folder hide no other module


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("own_law:Missing", "own_law has no class 'Missing'"),
        ("own_law:number", "own_law has no class 'number'"),
        ("own_law:NoUpdate", "has no method update"),
        ("own_law:Needy", "cannot be made: .*something"),
        ("own_law:Broken", "cannot be made: OSError: no weights here"),
        ("own_none:Good", "'own_none' cannot be imported: ModuleNotFoundError"),
        ("own_broken:Good", "'own_broken' cannot be imported: .*no_such_package"),
        ("own_broken.py:Good", "own_broken.py cannot be loaded: .*no_such_package"),
        ("own_none.py:Good", "there is no file own_none.py"),
        (":Good", "module is missing"),
    ],
)
def test_an_unusable_module_or_class_is_refused(own: Path, name: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        make_controller(name, LOOP)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Forgetful", "returned None; it must return the steering action"),
        ("Wordy", "returned 'left'"),
        ("Unstable", "returned nan"),
        ("Dividing", r"failed: ZeroDivisionError: .*own_law.py, line \d+"),
    ],
)
def test_a_users_update_that_fails_is_one_line(own: Path, name: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        make_controller(f"own_law.py:{name}", LOOP).update(SEEN)
    assert "\n" not in str(caught.value)
