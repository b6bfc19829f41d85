"""The compiled motion of a free rigid body equals PyBullet's."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.traffic.traffic import TRAFFIC_CAR_SIZE
from simulator.vehicle.car import CarParameters
from simulator.vehicle.dynamics import DT, MOTION, PIECE, compute_forces
from simulator.vehicle.rigid_body import advance_free, contact_possible, integrate
from simulator.vehicle.state import Command
from simulator.vehicle.surface import ground
from simulator.world.physics import PhysicsClient
from simulator.world.world import World

CAR = CarParameters()


def scene() -> PhysicsClient:
    made = PhysicsClient()
    made.rebuild([CAR])
    return made


def test_a_rotating_free_body_moves_as_in_pybullet() -> None:
    bullet, params = scene(), CAR.packed()
    here, there = np.zeros(MOTION), np.zeros(MOTION)
    here[:] = (1.0, 2.0, 30.0, 0.0, 0.0, 0.0, 1.0, 12.0, -3.0, 4.0, 0.7, -0.4, 1.1)
    there[:] = here
    rng = np.random.default_rng(0)
    for _ in range(400):
        wrench = rng.normal(0.0, 1.0, 6) * (3e3, 3e3, 3e3, 1e3, 1e3, 1e3)
        bullet.set_motion(bullet.cars[0], there)
        bullet.apply_wrench(bullet.cars[0], wrench, there)
        bullet.step()
        bullet.read(bullet.cars[0], there)
        integrate(params[0], here, wrench.copy())
    np.testing.assert_allclose(here, there, rtol=0.0, atol=1e-9)
    bullet.close()


@pytest.mark.parametrize("track", ["mountain-pass", "circuit"])
def test_compiled_motion_equals_pybullet_motion(track: str) -> None:
    road = Road(find_track(track))
    with World(road) as world:
        state = world.reset(seed=0, speed=15.0)
        bullet, memory, motion = scene(), world._memory.copy(), world._motion.copy()
        wrench, apart = np.zeros(6), []
        for step in range(400):
            steer = 0.2 * math.sin(0.1 * step) - 0.3 * state.to_middle + state.angle
            command = Command(steer=max(-1.0, min(1.0, steer)), throttle=0.25)
            controls = np.array([command.steer, command.throttle, 0.0, 1.0])
            state = world.step(command)
            for _ in range(10):
                params, table = world._params, road.track.arrays()
                compute_forces(params, table, ground(road), motion, memory, controls, wrench)
                bullet.set_motion(bullet.cars[0], motion)
                bullet.apply_wrench(bullet.cars[0], wrench, motion)
                bullet.step()
                bullet.read(bullet.cars[0], motion)
            apart.append(math.hypot(motion[0] - state.x, motion[1] - state.y))
        assert state.odometer_m > 200.0
        assert max(apart) < 1e-8
        bullet.close()


def test_compiled_motion_stops_before_a_possible_contact() -> None:
    road = Road(find_track("circuit"))
    with World(road) as world:
        world.reset(seed=0, s=100.0, to_middle=2.0, angle=-1.2, speed=60.0)
        motion, memory = world._motion, world._memory
        others = np.zeros((0, 6))
        arguments = (world._params, road.track.arrays(), ground(road), motion, memory)
        controls, reach = np.array([0.0, 0.0, 0.0, 0.0]), road.wall_offset
        done = advance_free(*arguments, controls, reach, others, others, 0, 200)
        assert 0 < done < 200
        reached = float(road.track.project(motion[0], motion[1])[1])
        assert reach - 3.5 < reached < reach - 3.5 + 60.0 * DT
        # It starts no more than a step away from touching.
        assert advance_free(*arguments, controls, reach, others, others, 0, 200) == 0


def near(road: Road, world: World, other: NDArray[np.float64], goes: float, share: float) -> bool:
    motion, piece = world._motion, int(world._memory[PIECE])
    move = np.array([[goes, 0.0, 0.0, 0.0, 0.0, 0.0]])
    table, params = road.track.arrays(), world._params[0]
    return bool(contact_possible(params, table, motion, piece, 1e3, other, move, share))


def test_contact_is_predicted_before_a_touch_but_not_for_the_next_lane() -> None:
    road = Road(find_track("circuit"))
    with World(road) as world:
        state = world.reset(seed=0, s=5.0, speed=20.0)
        assert state.curvature == 0.0
        bumpers = 0.5 * (CAR.length + TRAFFIC_CAR_SIZE[0])
        step = (20.0 + 20.0) * DT + 0.3
        other = np.array([[state.x, state.y, 0.0, 0.0, 0.0, state.yaw]])
        ahead, left = np.array([math.cos(state.yaw), math.sin(state.yaw)]), np.zeros(2)
        left[:] = -ahead[1], ahead[0]
        for way, touching in ((ahead, bumpers), (left, 0.5 * (CAR.width + TRAFFIC_CAR_SIZE[1]))):
            other[0, :2] = (state.x, state.y) + way * (touching + step - 0.01)
            assert near(road, world, other, 0.0, 0.0)
            other[0, :2] += 0.02 * way
            assert not near(road, world, other, 0.0, 0.0)
        other[0, :2] = (state.x, state.y) + left * 4.0
        assert not near(road, world, other, 0.0, 0.0)
        # Half of its way it will have come nearer.
        other[0, :2] = (state.x, state.y) + ahead * 6.0
        assert state.yaw == pytest.approx(0.0, abs=1e-9)
        assert not near(road, world, other, -4.0, 0.0)
        assert near(road, world, other, -4.0, 0.5)
