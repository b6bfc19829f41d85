"""What happens while the car may touch something: PyBullet moves it, the wrecks and what is near.

Traffic on its way is a body of PyBullet's only while something may touch it. The blow that it then
gets makes it a wreck, which goes where physics sends it.
"""

import numpy as np
from numpy.typing import NDArray

from simulator.track.kernel import locate
from simulator.track.road import Road
from simulator.traffic.traffic import Traffic
from simulator.traffic.wreck import TRAFFIC_CAR, Wreck, path_motion
from simulator.vehicle.car import CarParameters
from simulator.vehicle.dynamics import MOTION, PIECE, advance
from simulator.vehicle.rigid_body import NEAR_CAR_M, NEAR_WALL_M
from simulator.vehicle.state import Collision
from simulator.vehicle.surface import ground
from simulator.world.physics import Scene
from simulator.world.walls import Walls

FloatArray = NDArray[np.float64]


class Impacts:
    """The part of a world in which bodies meet. `start` begins an episode."""

    def __init__(self, road: Road, car: CarParameters) -> None:
        self._scene = Scene()
        self._walls = Walls(road)
        self._table, self._ground = road.track.arrays(), ground(road)
        self._car = car
        self._params, self._other = car.packed(), TRAFFIC_CAR.packed()
        self._wrench, self._on_path = np.zeros(6), np.zeros(MOTION)
        self._near: list[int] = []
        self._wrecks: dict[int, Wreck] = {}

    def start(self, traffic: Traffic) -> None:
        """Begin an episode among `traffic`; nothing of the one before is left."""
        self._scene.rebuild([self._car] + [TRAFFIC_CAR] * traffic.count)
        self._traffic = traffic
        self._near, self._wrecks = [], {}

    @property
    def going_on(self) -> bool:
        """Whether a wreck is still moving, so that every step is PyBullet's."""
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
        """Advance the car (`motion`, `memory`), and who is near, by one physics step.

        others (n, 6) and move (n, 6): the traffic's ground poses at the start of the control step
        of `dt` s and how far it goes in it; `share` of the control step is done. Returns what the
        car touched; "traffic" comes before "wall".
        """
        scene = self._scene
        advance(self._params, self._table, self._ground, motion, memory, controls, self._wrench)
        self._send(0, motion, memory, self._wrench)
        self._gather(motion, others + share * move)
        for row in self._near:
            wreck = self._wrecks.get(row)
            if wreck is not None:
                wrench = wreck.forces(self._other, self._table, self._ground)
                self._send(row + 1, wreck.motion, wreck.memory, wrench)
            else:
                path_motion(others[row], move[row], share, dt, self._on_path)
                scene.put(scene.cars[row + 1], self._on_path)
        scene.step()
        scene.read(scene.cars[0], motion)
        touched = self._strike()
        self._follow()
        return touched

    def close(self) -> None:
        self._scene.close()

    def _send(self, index: int, motion: FloatArray, memory: FloatArray, wrench: FloatArray) -> None:
        """Give PyBullet a car, the forces on it, and the wall beside it."""
        scene = self._scene
        scene.put(scene.cars[index], motion)
        scene.push(scene.cars[index], wrench, motion)
        _, s, d = locate(self._table, motion[0], motion[1], int(memory[PIECE]))
        panel = self._walls.panel(s, d, NEAR_WALL_M)
        if panel is None:
            scene.put_aside(scene.walls[index])
        else:
            scene.put_wall(scene.walls[index], panel)

    def _gather(self, motion: FloatArray, places: FloatArray) -> None:
        """Choose the traffic that takes part in the next step: who is near the car or a moving
        wreck, and the moving wrecks."""
        moving = [row for row, wreck in self._wrecks.items() if wreck.moving]
        centres = [motion[:2], *(self._wrecks[row].motion[:2] for row in moving)]
        near = set(moving)
        for centre in centres:
            apart = np.hypot(places[:, 0] - centre[0], places[:, 1] - centre[1])
            near.update(np.flatnonzero(apart < NEAR_CAR_M).tolist())
        for row in self._near:
            if row not in near:
                self._scene.put_aside(self._scene.cars[row + 1])
        self._near = sorted(near)

    def _strike(self) -> Collision | None:
        """Make wrecks of the traffic that was touched; returns what the car touched."""
        cars = self._scene.cars
        touched: set[int] = set()
        for pair in self._scene.contacts():
            for body in pair:
                if body in cars[1:]:
                    self._wreck(cars.index(body) - 1)
            if cars[0] in pair:
                touched.update(pair)
        if touched & set(cars[1:]):
            return "traffic"
        return "wall" if touched else None

    def _wreck(self, row: int) -> None:
        """Let the traffic's car `row` be moved by physics from now on."""
        if row in self._wrecks:
            self._wrecks[row].moving = True
            return
        s, speed = float(self._traffic.s[row]), float(self._traffic.speed[row])
        self._wrecks[row] = Wreck.of(row, np.zeros(MOTION), s, speed, self._table)
        self._traffic.strike(row)

    def _follow(self) -> None:
        """Take the wrecks' motions over, and show them to the traffic."""
        for row in self._near:
            wreck = self._wrecks.get(row)
            if wreck is not None:
                self._scene.read(self._scene.cars[row + 1], wreck.motion)
                wreck.settle()
                self._traffic.displace(row, *wreck.seen(self._table))
