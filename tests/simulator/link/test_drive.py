"""States from a server process are bit-identical to those of a World in this process."""

import math
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from simulator.env.reward import ending, step_reward
from simulator.link.client import Link
from simulator.link.layout import STATE, Mode
from simulator.link.message import Message, read_message
from simulator.sensors.standard import read_range, read_track_range
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import CarState, Command
from simulator.world.world import World
from trackfeatures.camera import CameraParameters

WAIT_S = 180.0


def law(state: CarState) -> Command:
    """The steering law of the TORCS reference laps, as in lap.c."""
    th = -state.angle
    wheel = -(
        state.to_middle
        + 0.1 * (state.vy + state.vx * math.sin(th))
        + 2.0 * th
        + 0.1 * state.yaw_rate
    )
    return Command(steer=min(max(wheel / 0.36652, -1.0), 1.0), throttle=0.2)


def assert_same(message: Message, world: World, reward: float) -> None:
    state = world.state
    assert message.state == state
    assert message.features == world.features()
    assert np.array_equal(message.ranges, read_track_range(world))
    assert np.array_equal(message.ranges_traffic, read_range(world))
    assert (message.reward, message.ended) == (reward, ending(state))


def reward_of(world: World) -> float:
    state = world.state
    ended = ending(state) is not None
    return step_reward(state.angle, state.to_middle, world.road.half_width, ended)


def test_states_equal_those_of_a_local_world(oval: str) -> None:
    start = {"s": 400.0, "to_middle": 1.5, "angle": -0.05, "speed": 15.0}
    with World(Road(find_track("oval"), 2)) as world, Link(oval, wait_s=WAIT_S) as link:
        message = link.reset(seed=3, **start)
        world.reset(seed=3, **start)
        assert_same(message, world, 0.0)
        score = 0.0
        for step in range(1, 151):
            command = law(message.state)
            message = link.step(command)
            world.step(command)
            score += reward_of(world)
            assert_same(message, world, reward_of(world))
            assert (message.step, message.score, message.seed) == (step, score, 3)


def test_states_and_images_equal_those_of_a_local_world_with_traffic(
    server: Callable[..., "subprocess.Popen[str]"], name: str
) -> None:
    from simulator.camera import Camera, Light

    options = ("--track", "town", "--lanes", "2", "--traffic", "6", "--camera", "45x33")
    server(*options, "--light", "dusk", "--seed", "4", "--frequency", "10")
    road = Road(find_track("town"), 2)
    light = Light.named("dusk", np.random.default_rng([4, 2]))
    with (
        World(road, traffic=6, frequency_hz=10) as world,
        Camera(road, CameraParameters(45, 33), seed=4, light=light) as camera,
        Link(name, wait_s=WAIT_S) as link,
    ):
        assert (link.info.traffic, link.info.frequency_hz, link.info.lanes) == (6, 10, 2)
        assert (link.info.image_width, link.info.image_height) == (45, 33)
        message = link.reset(seed=5)
        world.reset(seed=5)
        for _ in range(30):
            command = law(message.state)
            message = link.step(command)
            world.step(command)
            assert_same(message, world, reward_of(world))
            assert message.image is not None
            picture = camera.render(world.body_pose(), world.traffic.poses())
            assert np.array_equal(message.image, picture)
            assert picture.std() > 5.0


def test_server_info_describes_road_car_and_camera(oval: str) -> None:
    road = Road(find_track("oval"), 2)
    with Link(oval, wait_s=WAIT_S) as link:
        info = link.info
    assert (info.track, info.lanes, info.lane_width, info.traffic) == ("oval", 2, 4.0, 0)
    assert info.track_length == road.track.length_m
    assert (info.half_width, info.edge) == (road.half_width, road.edge)
    assert (info.frequency_hz, info.mode, info.image_width) == (20, Mode.LOCK_STEP, 0)
    assert info.beam_angles == pytest.approx(np.radians(np.arange(90, -91, -10)))


def test_a_lap_of_the_c_client_is_bit_identical_to_python(
    oval: str, lap_program: Path, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    done = subprocess.run(
        [str(lap_program), oval, "1", str(log)], capture_output=True, text=True, timeout=240
    )
    assert (done.returncode, done.stderr) == (0, "")
    rows = np.fromfile(log, STATE.dtype)
    crossed: list[float] = []
    largest = 0.0
    with World(Road(find_track("oval"), 2)) as world:
        state = world.reset(seed=1)
        for row in rows:
            assert read_message(row, None).state == state
            if row["lap"] > len(crossed):
                crossed.append(state.time_s)
            if row["lap"] == 1:
                largest = max(largest, abs(state.to_middle))
            state = world.step(law(state))
    assert len(crossed) == 2
    said = re.search(r"lap time ([\d.]+) s, largest \|d\| ([\d.]+) m, (\d+) steps", done.stdout)
    assert said is not None, done.stdout
    assert float(said[1]) == pytest.approx(crossed[1] - crossed[0], abs=0.005)
    assert float(said[2]) == pytest.approx(largest, abs=5e-7)
    assert int(said[3]) == len(rows) - 1
    assert 100.0 < float(said[1]) < 120.0
    assert 0.001 < largest < 0.5
