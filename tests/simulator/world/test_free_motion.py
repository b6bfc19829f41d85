"""Compiled code moves the car until its box overlaps another; only then PyBullet is imported."""

import importlib
import math
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from simulator.arrays import FloatArray
from simulator.track.catalogue import find_track
from simulator.track.piece_table import locate
from simulator.track.road import Road
from simulator.traffic.wreck import TRAFFIC_CAR
from simulator.vehicle.car import CarParameters
from simulator.vehicle.dynamics import DT, PIECE
from simulator.vehicle.state import Collision, Command
from simulator.world.boxes import AXES, BOX, HALF, box_radius, boxes_overlap
from simulator.world.collisions import CONTACT_MARGIN_M, ContactPhysics
from simulator.world.free_motion import touches
from simulator.world.world import World
from trackfeatures.errors import UserError

CAR = CarParameters()
COAST = Command(gear=0)


@pytest.fixture
def without_pybullet(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a machine where PyBullet is not installed."""
    monkeypatch.setitem(sys.modules, "pybullet", None)
    monkeypatch.delitem(sys.modules, "simulator.world.physics", raising=False)
    monkeypatch.delattr("simulator.world.physics", raising=False)


def coast(world: World, steps: int) -> list[Collision | None]:
    """What the car touched in each step."""
    return [world.step(COAST).collision for _ in range(steps)]


def random_box(rng: np.random.Generator, spread: float) -> FloatArray:
    box = np.empty(BOX)
    box[:3] = rng.uniform(-spread, spread, 3)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    if rng.uniform() < 0.3:  # parallel axes, as of two cars on a level road
        turn = np.eye(3)
    box[AXES:HALF] = turn.ravel()
    box[HALF:] = rng.uniform(0.3, 2.5, 3)
    return box


def share_a_point(a: FloatArray, b: FloatArray, grown: float) -> bool:
    """Whether a point lies in both boxes, `b` grown by `grown` m: a linear program."""
    rows, limits = [], []
    for box, more in ((a, 0.0), (b, grown)):
        for axis, half in zip(box[AXES:HALF].reshape(3, 3), box[HALF:], strict=True):
            for side in (1.0, -1.0):
                rows.append(side * axis)
                limits.append(half + more + side * axis @ box[:3])
    free = [(None, None)] * 3
    found = linprog(np.zeros(3), A_ub=np.array(rows), b_ub=np.array(limits), bounds=free)
    return bool(found.status == 0)


def test_box_overlap_equals_a_linear_program() -> None:
    rng, overlaps = np.random.default_rng(0), 0
    for _ in range(300):
        a, b = random_box(rng, 2.5), random_box(rng, 2.5)
        expected = share_a_point(a, b, 0.0)
        assert boxes_overlap(a, b, 0.0) == boxes_overlap(b, a, 0.0) == expected
        if not share_a_point(a, b, 0.3 * math.sqrt(3.0)):  # no gap of 0.3 m either
            assert not boxes_overlap(a, b, 0.3)
        overlaps += expected
    assert 60 < overlaps < 240


def in_touch(world: World, others: FloatArray, move: FloatArray, share: float = 0.0) -> bool:
    contacts, motion = world._contacts, world._motion
    other, radius = TRAFFIC_CAR.packed(), box_radius(world._params[0])
    table, walls = world.road.track.arrays(), contacts.walls.arrays
    at = locate(table, motion[0], motion[1], int(world._memory[PIECE]))
    arguments = (world._params, other, table, walls, motion, at, others, move, share, 0.05)
    return bool(touches(*arguments, 0.0, radius))


def test_a_touch_begins_where_bumpers_and_sides_meet() -> None:
    with World(Road(find_track("oval"))) as world:
        state = world.reset(seed=0, s=5.0)
        assert state.curvature == 0.0
        ahead = np.array([math.cos(state.yaw), math.sin(state.yaw)])
        left = np.array([-ahead[1], ahead[0]])
        other, move = np.zeros((1, 6)), np.zeros((1, 6))
        other[0, 2], other[0, 5] = state.z - CAR.cg_height, state.yaw
        for way, meeting in (
            (ahead, 0.5 * (CAR.length + TRAFFIC_CAR.length)),
            (left, 0.5 * (CAR.width + TRAFFIC_CAR.width)),
        ):
            for sign in (1.0, -1.0):
                for gap, touching in ((-1e-3, True), (1e-3, False)):
                    other[0, :2] = (state.x, state.y) + sign * way * (meeting + gap)
                    assert in_touch(world, other, move) == touching
        # The traffic car drives back 4 m in the control step: after 1/4 of the step, 1 m.
        other[0, :2] = (state.x, state.y) + ahead * (0.5 * (CAR.length + TRAFFIC_CAR.length) + 1.0)
        move[0, :2] = -4.0 * ahead
        assert not in_touch(world, other, move, 0.249)
        assert in_touch(world, other, move, 0.251)
        # Under a bridge: the same place, 5 m higher.
        other[0, 2] += 5.0
        assert not in_touch(world, other, move, 0.251)


@pytest.mark.parametrize("angle", [0.1, 0.3, 0.8, 1.4])
@pytest.mark.parametrize("side", [1, -1])
def test_a_wall_is_touched_when_the_cars_corner_meets_it(
    side: int, angle: float, without_pybullet: None
) -> None:
    """At 200 Hz the last step before the contact needs no PyBullet."""
    with World(Road(find_track("oval")), frequency_hz=200) as world:
        world.reset(seed=0, s=5.0, to_middle=side * 5.0, angle=-side * angle, speed=15.0)
        with pytest.raises(UserError, match="the car touched a wall or another car"):
            coast(world, 600)
        assert world.state.curvature == 0.0
        # The state is that of the step before: less than a step's way from the wall. The body rolls
        # and pitches by up to 0.02 rad, which moves its corners by up to 4 cm.
        assert -0.04 < gap_to_wall(world) < 15.0 * DT + 0.04


@pytest.mark.contacts
def test_the_error_without_pybullet_names_what_to_install(
    monkeypatch: pytest.MonkeyPatch, without_pybullet: None
) -> None:
    with World(Road(find_track("oval"))) as world:
        world.reset(seed=0, angle=-1.2, speed=20.0)
        with pytest.raises(UserError, match=r"pip install 'driverview\[contacts\]'"):
            coast(world, 40)
        # With PyBullet the same world goes on.
        monkeypatch.undo()
        importlib.import_module("simulator.world.physics")
        assert world.reset(seed=0, angle=-1.2, speed=20.0).collision is None
        assert "wall" in coast(world, 40)


def test_a_car_close_to_wall_and_traffic_needs_no_pybullet(without_pybullet: None) -> None:
    """Half a metre beside the wall, and bumper to bumper with a traffic car that drives ahead."""
    with World(Road(find_track("oval")), traffic=1) as world:
        beside = world.road.wall_offset - 0.5 * CAR.width - 0.05
        with pytest.raises(UserError, match="the road ends"):
            world.reset(seed=0, to_middle=beside)
        state = world.reset(seed=0, s=5.0)
        # The car is placed there, along the wall of a straight.
        world._place(5.0, beside, 0.0, 15.0)
        for _ in range(20):
            state = world.step(COAST)
        assert state.off_track
        assert abs(state.to_middle - beside) < 0.04
        place = float(world.traffic.s[0]) - 0.5 * (CAR.length + TRAFFIC_CAR.length) - 0.1
        lane = float(world.traffic.to_middle[0])
        world._place(place, lane, 0.0, float(world.traffic.speed[0]))
        assert world.step(Command(brake=0.3, gear=0)).collision is None


def gap_to_wall(world: World) -> float:
    """Gap (m) between the wall and the nearest corner of a car that stands level."""
    now = world.state
    sin, cos = abs(math.sin(now.angle)), math.cos(now.angle)
    corner = 0.5 * (CAR.length * sin + CAR.width * cos)
    return world.road.wall_offset - abs(now.to_middle) - corner


@pytest.mark.contacts
def test_pybullet_moves_the_car_from_the_touch_until_the_gap_exceeds_its_threshold(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A car slides along a wall, and steers away from it."""
    calls: list[int] = []
    step, whole = 0, ContactPhysics.step

    def counted(self: ContactPhysics, *arguments: Any) -> Collision | None:
        calls.append(step)
        return whole(self, *arguments)

    monkeypatch.setattr(ContactPhysics, "step", counted)
    with World(Road(find_track("oval")), frequency_hz=200) as world:
        world.reset(seed=0, s=5.0, to_middle=6.5, angle=-0.1, speed=15.0)
        gaps = []
        for step in range(450):
            world.step(Command(steer=0.02 if step < 350 else -0.3, gear=0))
            gaps.append(gap_to_wall(world))
    assert calls == list(range(calls[0], calls[-1] + 1))  # one contact, without a pause
    assert 150 < calls[0] < 250
    assert calls[-1] < 449
    assert max(abs(gap) for gap in gaps[calls[0] : 350]) < 0.01
    assert min(gaps) > -0.01
    # The boxes overlap before the first of these steps, and no longer after the last.
    assert gaps[calls[0] - 1] < 0.0 < gaps[calls[0] - 2]
    assert gaps[calls[-1]] == pytest.approx(CONTACT_MARGIN_M, abs=0.01)


@pytest.mark.contacts
def test_a_contact_needs_no_stderr() -> None:
    """PyBullet's greeting on stderr is hidden at import; a daemon has stderr closed."""
    code = """
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import Command
from simulator.world.world import World
with World(Road(find_track("oval"))) as world:
    world.reset(seed=0, angle=-1.2, speed=20.0)
    print("wall" in [world.step(Command(gear=0)).collision for _ in range(40)])
"""
    for end in ("2>&-", ""):
        command = ["sh", "-c", f'exec "$0" -c "$1" {end}', sys.executable, code]
        done = subprocess.run(command, capture_output=True, text=True)
        assert (done.stdout, done.stderr) == ("True\n", "")


def test_driving_imports_no_pybullet() -> None:
    """In a process of its own: a world with traffic, an environment, and a contact at the end."""
    code = """
import sys, gymnasium, simulator.env
env = gymnasium.make("driverview/LateralControl-v0", track="oval", lanes=2)
env.reset(seed=0)
for _ in range(50):
    env.step([0.0])
env.close()
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import Collision, Command
from simulator.world.world import World
with World(Road(find_track("oval"), 2), traffic=6) as world:
    world.reset(seed=0)
    for _ in range(50):
        world.step(Command(throttle=0.2))
print(bool(sys.modules.get("pybullet")))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("False\n", "")
