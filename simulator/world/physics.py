"""The PyBullet side of a world: cars and pieces of wall as rigid bodies.

One DIRECT client a scene. Positions in m, world frame, z up; quaternions (x, y, z, w). A body's
frame is its centre of gravity.
"""

import math
import weakref
from collections.abc import Iterator, Sequence

import numpy as np
import pybullet
from numpy.typing import NDArray

from simulator.vehicle.car import CarParameters
from simulator.world.walls import PANEL, Panel
from trackfeatures.errors import UserError

GROUND_CLEARANCE = 0.12  # m from the road to the underside of a car's box
CONTACT_FRICTION = 0.3  # bodywork on rails and bodywork
RESTITUTION = 0.1
SOLVER_ITERATIONS = 20
ASIDE_M = 1_000.0  # below the road, where a box waits that nothing can meet

Motion = NDArray[np.float64]


class Scene:
    """The bodies of one world. Only this class talks to PyBullet.

    `cars` are PyBullet's numbers of the cars, the driver's own first; each has a panel of wall of
    its own in `walls`, which is there for it alone.
    """

    def __init__(self) -> None:
        self._client = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise UserError("PyBullet has no free client; close worlds that are no longer needed")
        # A world that is dropped without close() still gives its client back.
        self._release = weakref.finalize(self, pybullet.disconnect, self._client)
        self.cars: list[int] = []
        self.walls: list[int] = []

    def rebuild(self, cars: Sequence[CarParameters]) -> None:
        """Start afresh with these cars: nothing of an earlier episode, such as cached contacts, can
        then reach into the next."""
        if not self._release.alive:
            raise UserError("this world is closed; make a new one")
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
        pybullet.setGravity(0.0, 0.0, 0.0, physicsClientId=client)  # in the wrench already
        self.cars = [self._add_car(car) for car in cars]
        self.walls = [self._add_panel() for _ in cars]
        everybody = (1 << len(cars)) - 1
        for index, (car, wall) in enumerate(zip(self.cars, self.walls, strict=True)):
            mine, its = 1 << index, 1 << (index + 16)
            pybullet.setCollisionFilterGroupMask(car, -1, mine, everybody | its, client)
            pybullet.setCollisionFilterGroupMask(wall, -1, its, mine, client)
        for body in (*self.cars, *self.walls):
            self.put_aside(body)
        self.step()  # PyBullet takes a new inertia over at the end of a step only

    def put(self, body: int, motion: Motion) -> None:
        """Give a body a motion (13,): position, quaternion, velocity, turning."""
        m, client = motion.tolist(), self._client
        pybullet.resetBasePositionAndOrientation(body, m[:3], m[3:7], physicsClientId=client)
        pybullet.resetBaseVelocity(body, m[7:10], m[10:], physicsClientId=client)

    def put_wall(self, body: int, panel: Panel) -> None:
        """Stand a panel of wall up."""
        turn = [0.0, 0.0, math.sin(0.5 * panel.yaw), math.cos(0.5 * panel.yaw)]
        place = [panel.x, panel.y, panel.z]
        pybullet.resetBasePositionAndOrientation(body, place, turn, physicsClientId=self._client)

    def put_aside(self, body: int) -> None:
        """Take a body out of everybody's way, each to a place of its own."""
        place, still = [20.0 * body, 0.0, -ASIDE_M], [0.0, 0.0, 0.0]
        client = self._client
        pybullet.resetBasePositionAndOrientation(body, place, [0, 0, 0, 1], physicsClientId=client)
        pybullet.resetBaseVelocity(body, still, still, physicsClientId=client)

    def push(self, body: int, wrench: NDArray[np.float64], motion: Motion) -> None:
        """Let (force, torque) (6,) act at the body's centre of gravity in the next step."""
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
        """Pairs of bodies that touched in the last step, some more than once."""
        for contact in pybullet.getContactPoints(physicsClientId=self._client):
            if contact[8] <= 0.0:
                yield contact[1], contact[2]

    def close(self) -> None:
        self._release()

    def _add_panel(self) -> int:
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=[0.5 * v for v in PANEL], physicsClientId=self._client
        )
        return self._surface(pybullet.createMultiBody(0, shape, physicsClientId=self._client))

    def _add_car(self, car: CarParameters) -> int:
        client = self._client
        tall = car.height - GROUND_CLEARANCE
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX,
            halfExtents=[0.5 * car.length, 0.5 * car.width, 0.5 * tall],
            collisionFramePosition=[0.0, 0.0, GROUND_CLEARANCE + 0.5 * tall - car.cg_height],
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
            mass=car.total_mass,  # the inertia alone would set the mass to 0
            linearDamping=0.0,
            angularDamping=0.0,
            localInertiaDiagonal=list(car.inertia),
            physicsClientId=client,
        )
        return self._surface(body)

    def _surface(self, body: int) -> int:
        pybullet.changeDynamics(
            body,
            -1,
            lateralFriction=CONTACT_FRICTION,
            restitution=RESTITUTION,
            physicsClientId=self._client,
        )
        return int(body)


# How often the physics steps, and what control rates that allows.


PHYSICS_HZ = 200


def check_frequency(frequency_hz: int) -> None:
    """Raises UserError for a control rate that the physics cannot keep."""
    if not 1 <= frequency_hz <= PHYSICS_HZ or PHYSICS_HZ % frequency_hz:  # true for NaN, too
        raise UserError(
            f"a control frequency of {frequency_hz} Hz does not divide the physics' "
            f"{PHYSICS_HZ} Hz; choose for example 10, 20, 40 or 50"
        )
