"""The compiled motion of a free rigid body equals PyBullet's."""

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest

from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.car import CarParameters
from simulator.vehicle.dynamics import MOTION, compute_forces
from simulator.vehicle.orientation import rotation
from simulator.vehicle.rigid_body import integrate
from simulator.vehicle.state import Command
from simulator.vehicle.surface import ground
from simulator.world.world import World

if TYPE_CHECKING:
    from simulator.world.physics import PhysicsClient

pytestmark = pytest.mark.contacts  # PyBullet is the oracle

CAR = CarParameters()


def scene() -> "PhysicsClient":
    from simulator.world.physics import PhysicsClient

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
        integrate(params[0], rotation(here[3:7]), here, wrench.copy())
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
