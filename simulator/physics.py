"""The PyBullet side of a world: the car's body, walls and traffic, as rigid bodies that collide.

One DIRECT client a scene. Positions in m, world frame, z up; quaternions (x, y, z, w).
"""

import weakref
from typing import Literal

import numpy as np
import pybullet
from numpy.typing import NDArray

from simulator.car import CarParameters
from simulator.dynamics import PHYSICS_HZ
from simulator.walls import Mesh
from trackfeatures.errors import UserError

Collision = Literal["traffic", "wall"]
Box = tuple[float, float, float]

GROUND_CLEARANCE = 0.12  # m from the road to the underside of the car's box
CONTACT_FRICTION = 0.3  # bodywork on rails and bodywork
RESTITUTION = 0.1
SOLVER_ITERATIONS = 20


class Scene:
    """The bodies of one world. Only this class talks to PyBullet."""

    def __init__(self, car: CarParameters, walls: Mesh) -> None:
        self._client = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise UserError("PyBullet has no free client; close worlds that are no longer needed")
        # A world that is dropped without close() still gives its client back.
        self._release = weakref.finalize(self, pybullet.disconnect, self._client)
        self._car = car
        self._vertices = walls.vertices.tolist()
        self._indices = walls.triangles.ravel().tolist()
        self._body, self._wall = -1, -1
        self._others: list[int] = []

    def rebuild(self, others: int, size: Box) -> None:
        """Start afresh with `others` traffic boxes: nothing of an earlier episode, such as cached
        contacts, can then reach into the next."""
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
        self._wall = self._add_walls()
        self._body = self._add_car()
        self._others = [self._add_box(size) for _ in range(others)]

    def place(self, motion: NDArray[np.float64]) -> None:
        """Put the car's body into a motion (13,): position, quaternion, velocity, turning."""
        m = motion.tolist()
        client = self._client
        pybullet.resetBasePositionAndOrientation(self._body, m[:3], m[3:7], physicsClientId=client)
        pybullet.resetBaseVelocity(self._body, m[7:10], m[10:], physicsClientId=client)

    def read(self, motion: NDArray[np.float64]) -> None:
        """Write the body's motion into `motion` (13,)."""
        place, turn = pybullet.getBasePositionAndOrientation(
            self._body, physicsClientId=self._client
        )
        velocity, spin = pybullet.getBaseVelocity(self._body, physicsClientId=self._client)
        motion[:] = (*place, *turn, *velocity, *spin)

    def push(self, wrench: NDArray[np.float64], motion: NDArray[np.float64]) -> None:
        """Apply (force, torque) (6,) at the centre of gravity and advance 1/200 s."""
        force, client = wrench.tolist(), self._client
        at = motion[:3].tolist()
        world = pybullet.WORLD_FRAME
        pybullet.applyExternalForce(self._body, -1, force[:3], at, world, physicsClientId=client)
        pybullet.applyExternalTorque(self._body, -1, force[3:], world, physicsClientId=client)
        pybullet.stepSimulation(physicsClientId=client)

    def move_others(self, poses: NDArray[np.float64], height: float) -> None:
        """Put the traffic boxes on their ground poses (n, 6): x, y, z, roll, pitch, yaw."""
        for body, pose in zip(self._others, poses.tolist(), strict=True):
            turn = pybullet.getQuaternionFromEuler(pose[3:])
            centre = [pose[0], pose[1], pose[2] + 0.5 * height]
            pybullet.resetBasePositionAndOrientation(
                body, centre, turn, physicsClientId=self._client
            )

    def set_others_velocity(self, velocities: NDArray[np.float64]) -> None:
        """Tell the solver how fast the boxes move (n, 3), so that a hit pushes as it should."""
        for body, velocity in zip(self._others, velocities.tolist(), strict=True):
            pybullet.resetBaseVelocity(
                body, velocity, [0.0, 0.0, 0.0], physicsClientId=self._client
            )

    def collision(self) -> Collision | None:
        """What the car's body touched in the last 1/200 s."""
        contacts = pybullet.getContactPoints(bodyA=self._body, physicsClientId=self._client)
        touched = {contact[2] for contact in contacts if contact[8] <= 0.0}
        if touched & set(self._others):
            return "traffic"
        return "wall" if self._wall in touched else None

    def close(self) -> None:
        self._release()

    def _add_walls(self) -> int:
        if not self._indices:
            return -1
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_MESH,
            vertices=self._vertices,
            indices=self._indices,
            flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
            physicsClientId=self._client,
        )
        return self._surface(pybullet.createMultiBody(0, shape, physicsClientId=self._client))

    def _add_car(self) -> int:
        car, client = self._car, self._client
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

    def _add_box(self, size: Box) -> int:
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=[0.5 * v for v in size], physicsClientId=self._client
        )
        return self._surface(
            pybullet.createMultiBody(
                0, shape, useMaximalCoordinates=1, physicsClientId=self._client
            )
        )

    def _surface(self, body: int) -> int:
        pybullet.changeDynamics(
            body,
            -1,
            lateralFriction=CONTACT_FRICTION,
            restitution=RESTITUTION,
            physicsClientId=self._client,
        )
        return int(body)
