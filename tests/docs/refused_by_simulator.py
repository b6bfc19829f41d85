"""What the simulator and the training of controllers refuse, and graphics that are missing.

`TRIES` has an attempt for each row of the page of errors, by the first words of the row.
"""

import copy
import sys
from pathlib import Path
from unittest import mock

import gymnasium as gym
import pytest

import simulator.env  # noqa: F401  # registers the environments
from controllers.compare.config import CompareConfig
from controllers.compare.run import compare
from controllers.rl.config import TrainConfig
from controllers.rl.run_folder import stored_config
from controllers.rl.training import train as train_actor
from simulator.camera.core.context import Graphics
from simulator.camera.core.turns import Turns
from simulator.env.vector import DriverViewVector, LateralControlVector
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.track.torcs.torcs import read_torcs
from simulator.varied.road import make_road
from simulator.vehicle.state import Command
from simulator.world.world import World
from tests.docs.attempts import Try, add_to, written


def environment() -> gym.Env[object, object]:
    return gym.make("driverview/LateralControl-v0", track="oval").unwrapped


def on_oval(command: Command | None = None, **start: float) -> object:
    with World(Road(find_track("oval"))) as world:
        return [world.reset(seed=0, **start), command and world.step(command)]


TRIES: dict[str, Try] = {
    "many cars with a state": lambda folder: train_actor(
        TrainConfig(folder / "run", "td3", envs=8, state="residual")
    ),
    "a folder to continue": stored_config,
    "a lane width for varied": lambda folder: make_road(find_track("oval"), 1, 3.5, "varied"),
    "an action or command": lambda folder: on_oval(Command(steer=1.00001)),
    "a start outside": lambda folder: on_oval(to_middle=40.0),
    "a step before the first reset": lambda folder: environment().step([0.0]),
    "a copy of an environment": lambda folder: copy.deepcopy(environment()),
    "an unknown track": lambda folder: find_track("no-such-track"),
    "a random road": lambda folder: find_track("random:x"),
}


@add_to(TRIES, "a contact without PyBullet")
def _(folder: Path) -> object:
    with pytest.MonkeyPatch.context() as patch, World(Road(find_track("oval"))) as world:
        patch.setitem(sys.modules, "pybullet", None)
        patch.delitem(sys.modules, "simulator.world.physics", raising=False)
        world.reset(seed=0, angle=-1.2, speed=20.0)
        return [world.step(Command(gear=0)) for _ in range(40)]


@add_to(TRIES, "a picture in a process")
def _(folder: Path) -> object:
    turns = Turns(mock.Mock(), (1, 2, 2, 3), free=lambda: None)
    with mock.patch("os.getpid", return_value=0), turns:  # as a forked child finds it
        return None


@add_to(TRIES, "steering of a controller's `update_batch` that is no number in [-1, 1]")
def _(folder: Path) -> object:
    law = "class Law:\n    def update(self, seen): ...\n    def update_batch(self, seen):\n"
    path = written(folder, "law.py", f"{law}        return [float('nan')]\n".encode())
    config = CompareConfig(folder / "out", tracks="oval", controllers=f"{path}:Law", steps=1)
    return compare(config)


@add_to(TRIES, "a bad action of one of many cars")
def _(folder: Path) -> object:
    cars = LateralControlVector(2, track="oval")
    cars.reset(seed=0)
    return cars.step([[0.0], [float("nan")]])


@add_to(TRIES, "a list with more or fewer entries than a vector has cars")
def _(folder: Path) -> object:
    return LateralControlVector(3, track=["oval", "town"])


@add_to(TRIES, "a process that draws")
def _(folder: Path) -> object:
    cars = DriverViewVector(1, track="oval")
    with mock.patch("simulator.camera.workers.pool.MODULE", "simulator.no_such_module"):
        return cars.reset(seed=0)


@add_to(TRIES, "EGL is missing")
def _(folder: Path) -> object:
    with mock.patch("moderngl.create_context", side_effect=ImportError("libEGL.so not loaded")):
        return Graphics()


@add_to(TRIES, "a TORCS track")
def _(folder: Path) -> object:
    length = '<attnum name="lg" unit="yard" val="9"/>'
    segment = f'<section name="a"><attstr name="type" val="str"/>{length}</section>'
    text = (
        '<params name="t"><section name="Header"><attnum name="version" val="4"/></section>'
        '<section name="Main Track"><attnum name="width" unit="m" val="12"/>'
        f'<section name="Track Segments">{segment}</section></section></params>'
    )
    return read_torcs(written(folder, "t.xml", text.encode()))
