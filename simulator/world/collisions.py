"""Physics steps with contacts: PyBullet moves the ego car, wrecks and nearby traffic.

This code runs while the ego car touches something or a wreck is moving; otherwise the compiled code
of `free_motion` moves the ego car. A traffic car that is hit becomes a wreck: it leaves the traffic
and moves as a rigid body. PyBullet is imported at the first contact of the process. World frame, SI
units.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from simulator.arrays import FloatArray
from simulator.track.piece_table import locate
from simulator.track.road import Road
from simulator.traffic.traffic import Traffic
from simulator.traffic.wreck import TRAFFIC_CAR, Wreck, lane_motion
from simulator.vehicle.car import CarParameters
from simulator.vehicle.dynamics import MOTION, PIECE, compute_forces
from simulator.vehicle.state import Collision
from simulator.vehicle.surface import ground
from simulator.world.boxes import box_radius
from simulator.world.errors import ContactsUnavailable
from simulator.world.walls import Walls

if TYPE_CHECKING:
    from simulator.world.physics import PhysicsClient

CONTACT_MARGIN_M = 0.02
"""PyBullet's contact threshold (m). Bodies with a larger gap have no effect on each other."""
STEP_MARGIN_M = 1.0
"""Upper bound on the distance (m) that two bodies approach each other in one physics step. Bodies
within this distance take part in the step."""


class ContactPhysics:
    """Computes the contacts of one world with PyBullet; `start` begins an episode."""

    def __init__(self, road: Road, car: CarParameters, walls: Walls) -> None:
        self.walls = walls
        self._client: PhysicsClient | None = None
        self._table, self._ground = road.track.arrays(), ground(road)
        self._car = car
        self._params, self._other = car.packed(), TRAFFIC_CAR.packed()
        self._wall_range = box_radius(self._params[0]) + STEP_MARGIN_M
        self._car_range = self._wall_range + box_radius(self._other[0])
        self._wrench, self._lane_motion = np.zeros(6), np.zeros(MOTION)

    def start(self, traffic: Traffic) -> None:
        """Begin an episode with `traffic`; all state of the previous episode is discarded."""
        self._traffic = traffic
        self._has_bodies = False
        self._active: list[int] = []
        self._wrecks: dict[int, Wreck] = {}

    @property
    def has_moving_wrecks(self) -> bool:
        """Whether a wreck is still moving; PyBullet must then compute every step."""
        return bool(self._wrecks) and any(wreck.moving for wreck in self._wrecks.values())

    def step(
        self,
        motion: FloatArray,
        memory: FloatArray,
        controls: FloatArray,
        others: FloatArray,
        move: FloatArray,
        share: float,
        dt: float,
    ) -> Collision | None:
        """Advance the ego car (`motion` (13,), `memory` (8,), in place) and nearby bodies by one
        physics step with `controls` (4,): steer, throttle, brake, gear.

        others (n, 6) and move (n, 6): ground poses of the traffic at the start of the control step
        of `dt` s, and their change over it; share: fraction of the control step already done.
        Returns what the ego car touched; "traffic" has priority over "wall". Raises
        ContactsUnavailable without PyBullet.
        """
        physics = self._bodies()
        compute_forces(
            self._params, self._table, self._ground, motion, memory, controls, self._wrench
        )
        self._load_body(physics, 0, motion, memory, self._wrench)
        self._select_nearby(physics, motion, others + share * move)
        for row in self._active:
            wreck = self._wrecks.get(row)
            if wreck is not None:
                wrench = wreck.forces(self._other, self._table, self._ground)
                self._load_body(physics, row + 1, wreck.motion, wreck.memory, wrench)
            else:
                lane_motion(others[row], move[row], share, dt, self._lane_motion)
                physics.set_motion(physics.cars[row + 1], self._lane_motion)
        physics.step()
        physics.read(physics.cars[0], motion)
        touched = self._process_contacts(physics)
        self._publish_wrecks(physics)
        return touched

    def close(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def _bodies(self) -> "PhysicsClient":
        """Return the PyBullet client with the bodies of this episode."""
        if self._client is None:
            self._client = _connect()
        if not self._has_bodies:
            self._client.rebuild([self._car] + [TRAFFIC_CAR] * self._traffic.count)
            self._has_bodies = True
        return self._client

    def _load_body(
        self,
        physics: "PhysicsClient",
        index: int,
        motion: FloatArray,
        memory: FloatArray,
        wrench: FloatArray,
    ) -> None:
        """Pass the motion of the car with index `index`, the `wrench` on it and the wall panel
        beside it to PyBullet. `memory` (8,) is the car's internal state, which contains its piece
        of the track."""
        physics.set_motion(physics.cars[index], motion)
        physics.apply_wrench(physics.cars[index], wrench, motion)
        _, s, d = locate(self._table, motion[0], motion[1], int(memory[PIECE]))
        panel = self.walls.panel(s, d, self._wall_range)
        if panel is None:
            physics.park(physics.walls[index])
        else:
            physics.place_wall(physics.walls[index], panel)

    def _select_nearby(
        self, physics: "PhysicsClient", motion: FloatArray, places: FloatArray
    ) -> None:
        """Select the traffic cars that take part in the next step: moving wrecks, and cars near a
        moving wreck or near the ego car with `motion` (13,). `places` (n, 2 or more) are the
        positions (m) of all traffic cars."""
        moving = [row for row, wreck in self._wrecks.items() if wreck.moving]
        centres = [motion[:2], *(self._wrecks[row].motion[:2] for row in moving)]
        near = set(moving)
        for centre in centres:
            distance = np.hypot(places[:, 0] - centre[0], places[:, 1] - centre[1])
            near.update(np.flatnonzero(distance < self._car_range).tolist())
        for row in self._active:
            if row not in near:
                physics.park(physics.cars[row + 1])
        self._active = sorted(near)

    def _process_contacts(self, physics: "PhysicsClient") -> Collision | None:
        """Turn touched traffic cars into wrecks; returns what the ego car touched."""
        cars = physics.cars
        touched: set[int] = set()
        for pair in physics.contacts():
            for body in pair:
                if body in cars[1:]:
                    self._make_wreck(cars.index(body) - 1)
            if cars[0] in pair:
                touched.update(pair)
        if touched & set(cars[1:]):
            return "traffic"
        return "wall" if touched else None

    def _make_wreck(self, row: int) -> None:
        """Make traffic car `row` a wreck, which physics moves from then on."""
        if row in self._wrecks:
            self._wrecks[row].moving = True
            return
        s, speed = float(self._traffic.s[row]), float(self._traffic.speed[row])
        self._wrecks[row] = Wreck.from_traffic(row, np.zeros(MOTION), s, speed, self._table)
        self._traffic.mark_struck(row)

    def _publish_wrecks(self, physics: "PhysicsClient") -> None:
        """Read the motions of the wrecks, and pass their poses to the traffic."""
        for row in self._active:
            wreck = self._wrecks.get(row)
            if wreck is not None:
                physics.read(physics.cars[row + 1], wreck.motion)
                wreck.update_rest()
                self._traffic.set_struck_pose(row, *wreck.pose_for_traffic(self._table))


def _connect() -> "PhysicsClient":
    """Return a new PyBullet client. Raises ContactsUnavailable if PyBullet is not installed or
    fails to load."""
    try:
        with _stderr_silenced():
            from simulator.world.physics import PhysicsClient
    except ImportError as error:
        raise ContactsUnavailable(
            f"the car touched a wall or another car; contacts need PyBullet ({error}): "
            "pip install 'driverview[contacts]' (from Python 3.12 on pip compiles it, with g++, in "
            "half an hour)"
        ) from None
    return PhysicsClient()


@contextmanager
def _stderr_silenced() -> Iterator[None]:
    """Hide the text that PyBullet prints to stderr when it is imported."""
    try:
        kept = os.dup(2)
    except OSError:  # it is closed: nothing to hide
        yield
        return
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)
