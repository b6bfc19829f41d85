"""VTORCS's world: one car on one road with walls and traffic, advanced by PyBullet at 200 Hz.

World frame: x, y in the plane, z up, yaw counter-clockwise; s and to_middle in the track frame.
"""

import math
from dataclasses import replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from simulator.car import GRIP, HIGHEST_GEAR, LOWEST_GEAR, RPM, CarParameters
from simulator.dynamics import (
    ENGINE,
    MEMORY,
    MOTION,
    ODOMETER,
    PHYSICS_HZ,
    PIECE,
    SPIN,
    STEER,
    advance,
    rotation,
)
from simulator.engine import gear_ratio
from simulator.orientation import quaternion
from simulator.physics import Collision, Scene
from simulator.state import CarState, Command
from simulator.track.geometry import wrap_angle
from simulator.track.kernel import index_at, locate, surface
from simulator.track.road import START_BEFORE_LINE_M, Road
from simulator.traffic import SIZE, Traffic
from simulator.walls import wall_mesh
from trackfeatures.errors import UserError

__all__ = ["CarState", "Command", "World"]

Poses = NDArray[np.float64]

ROLLING_BACK_M_S = -0.5
"""Slower than this along the track is driving backwards."""
NEAR_WALL_M = 3.5
"""No part of the car is farther than this from its centre of gravity, with a margin."""
NEAR_TRAFFIC_M = 8.0


class World:
    """One episode at a time; `reset` starts one, `step` holds a command for 1/frequency_hz s."""

    def __init__(
        self,
        road: Road,
        *,
        traffic: int = 0,
        frequency_hz: int = 20,
        car: CarParameters | None = None,
    ) -> None:
        if not 0 < frequency_hz <= PHYSICS_HZ or PHYSICS_HZ % frequency_hz:
            raise UserError(
                f"a control frequency of {frequency_hz} Hz does not divide the physics' "
                f"{PHYSICS_HZ} Hz; choose for example 10, 20, 40 or 50"
            )
        self.road = road
        self.frequency_hz = frequency_hz
        self.car = car or CarParameters()
        self._count = traffic
        self.traffic = Traffic(road, traffic, np.random.default_rng(0))
        on_surface = replace(self.car, friction=self.car.friction * GRIP[road.track.surface])
        self._params = on_surface.packed()
        self._table = road.track.arrays()
        self._scene = Scene(self.car, wall_mesh(road))
        self._motion = np.zeros(MOTION)
        self._memory = np.zeros(MEMORY)
        self._state: CarState | None = None

    @property
    def state(self) -> CarState:
        """The car now. Raises UserError before the first reset."""
        if self._state is None:
            raise UserError("the world has no episode yet; call reset(seed=...) first")
        return self._state

    def reset(
        self,
        *,
        seed: int,
        s: float | None = None,
        to_middle: float = 0.0,
        angle: float = 0.0,
        speed: float = 0.0,
    ) -> CarState:
        """Start an episode. `s` defaults to 25 m before the line; angle as in DESIGN (positive:
        the car points to the right of the track), rad; speed in m/s along the body.

        The episode is a function of the arguments alone, whatever this world did before.
        """
        start = -START_BEFORE_LINE_M if s is None else float(s)
        for name, value in (("s", start), ("to_middle", to_middle), ("angle", angle)):
            if not math.isfinite(value):
                raise UserError(f"reset got {name} = {value}; give a finite number")
        if not math.isfinite(speed) or abs(speed) > 150.0:
            raise UserError(f"reset got speed = {speed}; give m/s between -150 and 150")
        if abs(to_middle) > self.road.edge:
            raise UserError(
                f"reset got to_middle = {to_middle} m; the road ends {self.road.edge:.2f} m from "
                "its centre, so give less"
            )
        self.traffic = Traffic(
            self.road, self._count, np.random.default_rng([seed, 1]), clear_s=start
        )
        self._scene.rebuild(self.traffic.count, SIZE)
        self._place(start, to_middle, angle, speed)
        self._scene.place(self._motion)
        self._scene.move_others(self.traffic.poses(), SIZE[2])
        self._lap, self._steps, self._lap_start = 0, 0, 0
        self._s = float(start % self.road.track.length_m)
        self._state = self._measure(1, None)
        return self._state

    def step(self, command: Command) -> CarState:
        """Hold `command` for one control step; raises UserError for a value out of its range."""
        before = self.state
        controls = _checked(command)
        path = self._advance_traffic(before)
        watch = self._near_anything()
        hit: Collision | None = None
        substeps = PHYSICS_HZ // self.frequency_hz
        for substep in range(1, substeps + 1):
            if watch and path is not None:
                # In one jump a box could land deep inside the car, and be thrown out of it.
                self._scene.move_others(path[0] + path[1] * (substep / substeps), SIZE[2])
            wrench = advance(self._params, self._table, self._motion, self._memory, controls)
            self._scene.push(wrench, self._motion)
            self._scene.read(self._motion)
            if watch:
                hit = hit or self._scene.collision()
        if path is not None and not watch:
            self._scene.move_others(path[0] + path[1], SIZE[2])
        self._steps += 1
        self._state = self._measure(command.gear, hit)
        return self._state

    def features(self) -> tf.TrackFeatures:
        """The true track features of the present moment."""
        now = self.state
        return self.road.measure(now.s, now.to_middle, now.angle)

    def body_pose(self) -> NDArray[np.float64]:
        """x, y, z, roll, pitch, yaw of the centre of gravity (6,), as PyBullet's Euler angles."""
        now = self.state
        return np.array([now.x, now.y, now.z, now.roll, now.pitch, now.yaw])

    def close(self) -> None:
        """Give the physics client back; a closed world refuses to reset and to step."""
        self._scene.close()
        self._state = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _place(self, s: float, to_middle: float, angle: float, speed: float) -> None:
        """Stand the car on its wheels at a place of the road, rolling at `speed`."""
        piece = index_at(self._table, s)
        wrapped = s % self.road.track.length_m
        pose = self.road.track.at(s, to_middle)
        z, *normal = surface(self._table, piece, wrapped, to_middle)
        up = np.array(normal)
        yaw = float(pose.heading) - angle
        # In the road plane, and seen from above exactly in the direction of yaw.
        rise = -(up[0] * math.cos(yaw) + up[1] * math.sin(yaw)) / up[2]
        forward = np.array([math.cos(yaw), math.sin(yaw), rise])
        forward /= np.linalg.norm(forward)
        position = np.array([float(pose.x), float(pose.y), z]) + up * self.car.cg_height
        self._motion[:] = 0.0
        self._motion[0:3] = position
        self._motion[3:7] = quaternion(forward, np.cross(up, forward), up)
        self._motion[7:10] = speed * forward
        self._memory[:] = 0.0
        self._memory[PIECE] = piece
        self._memory[SPIN : SPIN + 4] = speed / self.car.wheel_radius
        turning = abs(speed) / self.car.wheel_radius * gear_ratio(self._params[0], 1)
        self._memory[ENGINE] = max(turning, self.car.idle_rpm / RPM)

    def _advance_traffic(self, before: CarState) -> tuple[Poses, Poses] | None:
        """Let the traffic drive one control step; returns where it was and how far it moves."""
        if not self.traffic.count:
            return None
        dt = 1.0 / self.frequency_hz
        old = self.traffic.poses()
        self.traffic.step(dt, before.s, before.to_middle, before.speed)
        move = self.traffic.poses() - old
        move[:, 3:] = (move[:, 3:] + math.pi) % (2.0 * math.pi) - math.pi
        self._scene.set_others_velocity(move[:, :3] / dt)
        return old, move

    def _near_anything(self) -> bool:
        """Whether the car may touch something within this step."""
        now = self.state
        if abs(now.to_middle) > self.road.wall_offset - NEAR_WALL_M:
            return True
        if not self.traffic.count:
            return False
        apart = self.traffic.poses()[:, :2] - (now.x, now.y)
        return bool(np.any(np.hypot(apart[:, 0], apart[:, 1]) < NEAR_TRAFFIC_M))

    def _measure(self, gear: int, hit: Collision | None) -> CarState:
        """Read the state off the body. The one place where angle = tangent - yaw is formed."""
        motion, memory, table = self._motion, self._memory, self._table
        piece, s, to_middle = locate(table, motion[0], motion[1], int(memory[PIECE]))
        memory[PIECE] = piece
        tangent, curvature = _tangent(table, piece, s)
        axes = rotation(motion[3:7])
        forward, left, up = axes.tolist()
        yaw = math.atan2(forward[1], forward[0])
        angle = float(wrap_angle(np.float64(tangent - yaw)))
        velocity = motion[7:10]
        along = math.cos(tangent) * velocity[0] + math.sin(tangent) * velocity[1]
        time_s = self._steps / self.frequency_hz
        self._count_laps(float(s))
        vx, vy = axes[0] @ velocity, axes[1] @ velocity
        return CarState(
            time_s=time_s,
            x=float(motion[0]),
            y=float(motion[1]),
            z=float(motion[2]),
            yaw=yaw,
            pitch=math.asin(max(-1.0, min(1.0, -forward[2]))),
            roll=math.atan2(left[2], up[2]),
            vx=float(vx),
            vy=float(vy),
            yaw_rate=float(axes[2] @ motion[10:13]),
            s=float(s),
            to_middle=float(to_middle),
            angle=angle,
            curvature=curvature,
            rpm=float(memory[ENGINE]) * RPM,
            gear=gear,
            wheel_spin=tuple(memory[SPIN : SPIN + 4].tolist()),
            steer=float(memory[STEER]) / self.car.steering_lock,
            lap=self._lap,
            odometer_m=float(memory[ODOMETER]),
            lap_time_s=(self._steps - self._lap_start) / self.frequency_hz,
            collision=hit,
            off_track=bool(abs(to_middle) > self.road.edge),
            backwards=bool(abs(angle) > 0.5 * math.pi or along < ROLLING_BACK_M_S),
        )

    def _count_laps(self, s: float) -> None:
        """Crossing the line adds a lap (crossing it backwards takes one away again)."""
        length = self.road.track.length_m
        moved = s - self._s
        if moved < -0.5 * length:
            self._lap += 1
            self._lap_start = self._steps
        elif moved > 0.5 * length:
            self._lap -= 1
        self._s = s


def _checked(command: Command) -> NDArray[np.float64]:
    """The command as (steer, throttle, brake, gear) for the kernel."""
    for name, value, low in (
        ("steer", command.steer, -1.0),
        ("throttle", command.throttle, 0.0),
        ("brake", command.brake, 0.0),
    ):
        if not low <= value <= 1.0:  # false for NaN too
            raise UserError(f"the command has {name} = {value}; it goes from {low:g} to 1")
    if command.gear != int(command.gear) or not LOWEST_GEAR <= command.gear <= HIGHEST_GEAR:
        raise UserError(f"the command has gear = {command.gear}; gears are -1, 0 and 1 to 6")
    return np.array([command.steer, command.throttle, command.brake, float(command.gear)])


def _tangent(table: NDArray[np.float64], piece: int, s: float) -> tuple[float, float]:
    """Heading (rad) and curvature (1/m) of the centre line at `s` on `piece`."""
    start, heading, curvature = table[piece, 0], table[piece, 4], table[piece, 5]
    along = min(max(s - start, 0.0), table[piece, 1])
    return float(heading + curvature * along), float(curvature)
