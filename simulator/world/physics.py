"""Cars and wall panels as rigid bodies in PyBullet, one DIRECT client per world.

Import this module only where a contact must be computed, because PyBullet is an optional package.
Positions in m, world frame, z up; quaternions (x, y, z, w). A body's origin is its centre of
gravity.
"""

import math
import weakref
from collections.abc import Iterator, Sequence

import numpy as np
import pybullet
from numpy.typing import NDArray

from simulator.vehicle.car import CarParameters
from simulator.world.boxes import box_height
from simulator.world.control_rate import PHYSICS_HZ
from simulator.world.walls import PANEL, Panel
from trackfeatures.errors import UserError

CONTACT_FRICTION = 0.3  # friction coefficient of car bodies on walls and on each other
RESTITUTION = 0.1
SOLVER_ITERATIONS = 20
PARKING_DEPTH_M = 1_000.0  # depth below the road at which unused bodies are out of contact

Motion = NDArray[np.float64]


class PhysicsClient:
    """The bodies of one world; only this class calls PyBullet.

    `cars` are the PyBullet ids of the cars, the ego car first. `walls` are the ids of one wall
    panel per car; a panel collides only with its car.
    """

    def __init__(self) -> None:
        self._client = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise UserError("PyBullet has no free client; close worlds that are no longer needed")
        # A world that is garbage-collected without close() still releases its client.
        self._release = weakref.finalize(self, pybullet.disconnect, self._client)
        self.cars: list[int] = []
        self.walls: list[int] = []

    def rebuild(self, cars: Sequence[CarParameters]) -> None:
        """Remove all bodies and create a body for each of `cars`, so that no state of an earlier
        episode (such as cached contacts) remains."""
        client = self._client
        pybullet.resetSimulation(physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=1.0 / PHYSICS_HZ,
            numSubSteps=0,
            numSolverIterations=SOLVER_ITERATIONS,
            deterministicOverlappingPairs=1,
            enableFileCaching=0,
            physicsClientId=client,
        )
        pybullet.setGravity(0.0, 0.0, 0.0, physicsClientId=client)  # gravity is in the wrench
        self.cars = [self._add_car(car) for car in cars]
        self.walls = [self._add_panel() for _ in cars]
        all_cars = (1 << len(cars)) - 1
        for index, (car, wall) in enumerate(zip(self.cars, self.walls, strict=True)):
            car_group, wall_group = 1 << index, 1 << (index + 16)
            pybullet.setCollisionFilterGroupMask(car, -1, car_group, all_cars | wall_group, client)
            pybullet.setCollisionFilterGroupMask(wall, -1, wall_group, car_group, client)
        for body in (*self.cars, *self.walls):
            self.park(body)
        self.step()  # PyBullet applies a new inertia only at the end of a step

    def set_motion(self, body: int, motion: Motion) -> None:
        """Set a body's motion (13,): position, quaternion, velocity, angular velocity."""
        m, client = motion.tolist(), self._client
        pybullet.resetBasePositionAndOrientation(body, m[:3], m[3:7], physicsClientId=client)
        pybullet.resetBaseVelocity(body, m[7:10], m[10:], physicsClientId=client)

    def place_wall(self, body: int, panel: Panel) -> None:
        """Move the wall panel `body` to the position `panel`."""
        turn = [0.0, 0.0, math.sin(0.5 * panel.yaw), math.cos(0.5 * panel.yaw)]
        place = [panel.x, panel.y, panel.z]
        pybullet.resetBasePositionAndOrientation(body, place, turn, physicsClientId=self._client)

    def park(self, body: int) -> None:
        """Move a body far below the road, out of reach of all other bodies. Each body has its own
        parking place."""
        place, still = [20.0 * body, 0.0, -PARKING_DEPTH_M], [0.0, 0.0, 0.0]
        client = self._client
        pybullet.resetBasePositionAndOrientation(body, place, [0, 0, 0, 1], physicsClientId=client)
        pybullet.resetBaseVelocity(body, still, still, physicsClientId=client)

    def apply_wrench(self, body: int, wrench: NDArray[np.float64], motion: Motion) -> None:
        """Apply `wrench` (6,), force (N) and torque (N m) in the world frame, in the next step. The
        force acts at the centre of gravity, the first three values of `motion` (13,)."""
        force, client, world = wrench.tolist(), self._client, pybullet.WORLD_FRAME
        at = motion[:3].tolist()
        pybullet.applyExternalForce(body, -1, force[:3], at, world, physicsClientId=client)
        pybullet.applyExternalTorque(body, -1, force[3:], world, physicsClientId=client)

    def step(self) -> None:
        """Advance all bodies by 1/200 s."""
        pybullet.stepSimulation(physicsClientId=self._client)

    def read(self, body: int, motion: Motion) -> None:
        """Write a body's motion into `motion` (13,)."""
        place, turn = pybullet.getBasePositionAndOrientation(body, physicsClientId=self._client)
        velocity, spin = pybullet.getBaseVelocity(body, physicsClientId=self._client)
        motion[:] = (*place, *turn, *velocity, *spin)

    def contacts(self) -> Iterator[tuple[int, int]]:
        """Yield the pairs of bodies in contact in the last step, some more than once."""
        for contact in pybullet.getContactPoints(physicsClientId=self._client):
            if contact[8] <= 0.0:
                yield contact[1], contact[2]

    def close(self) -> None:
        self._release()

    def _add_panel(self) -> int:
        """Create a wall panel; returns its PyBullet id."""
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=[0.5 * v for v in PANEL], physicsClientId=self._client
        )
        return self._set_contact_material(
            pybullet.createMultiBody(0, shape, physicsClientId=self._client)
        )

    def _add_car(self, car: CarParameters) -> int:
        """Create a car's box as a rigid body; returns its PyBullet id."""
        client = self._client
        half, above = box_height(car.height, car.cg_height)
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX,
            halfExtents=[0.5 * car.length, 0.5 * car.width, half],
            collisionFramePosition=[0.0, 0.0, above],
            physicsClientId=client,
        )
        body = int(
            pybullet.createMultiBody(
                car.total_mass, shape, useMaximalCoordinates=1, physicsClientId=client
            )
        )
        pybullet.changeDynamics(
            body,
            -1,
            mass=car.total_mass,  # setting the inertia alone would set the mass to 0
            linearDamping=0.0,
            angularDamping=0.0,
            localInertiaDiagonal=list(car.inertia),
            physicsClientId=client,
        )
        return self._set_contact_material(body)

    def _set_contact_material(self, body: int) -> int:
        pybullet.changeDynamics(
            body,
            -1,
            lateralFriction=CONTACT_FRICTION,
            restitution=RESTITUTION,
            physicsClientId=self._client,
        )
        return int(body)
