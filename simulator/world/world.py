"""The simulated world: one ego car on one road with walls and traffic, stepped at 200 Hz.

Compiled code moves the ego car until it touches a wall or another car (`free_motion`); then, and
while wrecks move, PyBullet computes the contacts (`collisions`). World frame: x, y in the plane, z
up, yaw counter-clockwise; s and to_middle in the track frame.
"""

import math
from typing import Self

import numpy as np

import trackfeatures as tf
from simulator.arrays import FloatArray
from simulator.bounds import clip_rounding
from simulator.track.piece_table import foot_offset, index_at, surface
from simulator.track.road import START_BEFORE_LINE_M, Road
from simulator.traffic.traffic import Traffic
from simulator.traffic.wreck import TRAFFIC_CAR
from simulator.vehicle.car import HIGHEST_GEAR, LOWEST_GEAR, RPM, CarParameters
from simulator.vehicle.dynamics import ENGINE, MEMORY, MOTION, ODOMETER, PIECE, SPIN, STEER
from simulator.vehicle.orientation import quaternion
from simulator.vehicle.powertrain import gear_ratio
from simulator.vehicle.state import CarState, Collision, Command
from simulator.vehicle.surface import ground
from simulator.vehicle.track_state import (
    ANGLE,
    PITCH,
    ROLL,
    TRACK_CURVATURE,
    TRACK_OFFSET,
    TRACK_S,
    TRACK_SPEED,
    TRACK_STATE_SIZE,
    VX,
    VY,
    YAW,
    YAW_RATE,
    measure_track_state,
)
from simulator.world.collisions import CONTACT_MARGIN_M, ContactPhysics
from simulator.world.control_rate import PHYSICS_HZ, check_frequency
from simulator.world.free_motion import advance_free
from trackfeatures.errors import UserError

__all__ = ["CarState", "Command", "World"]

BACKWARDS_SPEED_M_S = -0.5
"""Below this speed along the track, the car drives backwards."""
MAX_START_SPEED_M_S = 150.0
NO_TRAFFIC = np.zeros((0, 6))


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
        check_frequency(frequency_hz)
        self.road = road
        self.frequency_hz = int(frequency_hz)
        self.car = car or CarParameters()
        self._traffic_count = traffic
        self.traffic = Traffic(road, traffic, np.random.default_rng(0))
        self._params, self._other = self.car.packed(), TRAFFIC_CAR.packed()
        self._table = road.track.arrays()
        self._ground = ground(road)
        self._motion = np.zeros(MOTION)
        self._memory = np.zeros(MEMORY)
        self._readings = np.zeros(TRACK_STATE_SIZE)
        self._controls = np.zeros(4)
        self._contacts = ContactPhysics(road, self.car)
        self._state: CarState | None = None
        self._closed = False

    @property
    def state(self) -> CarState:
        """The current state of the ego car. Raises UserError before the first reset."""
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
        """Start an episode. `s` (m) defaults to 25 m before the line; `angle` is track tangent
        minus yaw (rad, positive when the car points to the right); `speed` in m/s along the body.

        The episode depends on the arguments only, not on earlier episodes. Raises UserError for a
        value out of range.
        """
        if self._closed:
            raise UserError("this world is closed; make a new one")
        start = -START_BEFORE_LINE_M if s is None else float(s)
        check_seed(seed)
        for name, value in (("s", start), ("to_middle", to_middle), ("angle", angle)):
            if not math.isfinite(value):
                raise UserError(f"reset got {name} = {value}; give a finite number")
        if not abs(speed) <= MAX_START_SPEED_M_S:  # true for NaN, too
            raise UserError(f"reset got speed = {speed}; give m/s between -150 and 150")
        if abs(to_middle) > self.road.edge:
            raise UserError(
                f"reset got to_middle = {to_middle} m; the road ends {self.road.edge:.2f} m from "
                "its centre, so give less"
            )
        self.traffic = Traffic(
            self.road, self._traffic_count, np.random.default_rng([seed, 1]), ego_s=start
        )
        self._contacts.start(self.traffic)
        self._in_contact = False
        self._place(start, to_middle, angle, speed)
        self._lap, self._steps, self._lap_start = 0, 0, 0
        self._s = float(start % self.road.track.length_m)
        self._state = self._build_state(1, None)
        return self._state

    def step(self, command: Command) -> CarState:
        """Hold `command` for one control step; raises UserError for a value out of its range."""
        before = self.state
        _fill_controls(command, self._controls)
        collision = self._advance_car(*self._advance_traffic(before))
        self._steps += 1
        self._state = self._build_state(command.gear, collision)
        return self._state

    def features(self) -> tf.TrackFeatures:
        """The true track features of the present moment.

        Distances are measured in the road plane, from the foot of the centre of gravity on it.
        """
        now = self.state
        piece = int(self._memory[PIECE])
        offset = foot_offset(self._table, piece, now.s, now.to_middle, now.z)
        return self.road.measure(now.s, offset, now.angle)

    def body_pose(self) -> FloatArray:
        """x, y, z, roll, pitch, yaw of the centre of gravity (6,), as PyBullet's Euler angles."""
        now = self.state
        return np.array([now.x, now.y, now.z, now.roll, now.pitch, now.yaw])

    def close(self) -> None:
        """Release the physics client; afterwards `reset` and `step` raise UserError."""
        self._contacts.close()
        self._state, self._closed = None, True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _place(self, s: float, to_middle: float, angle: float, speed: float) -> None:
        """Place the car on its wheels at (s, to_middle), rolling at `speed`."""
        piece = index_at(self._table, s)
        wrapped = s % self.road.track.length_m
        pose = self.road.track.at(s, to_middle)
        z, *normal = surface(self._table, piece, wrapped, to_middle)
        up = np.array(normal)
        yaw = float(pose.heading) - angle
        # Forward lies in the road plane; its projection on the x-y plane has the direction of yaw.
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

    def _advance_traffic(self, before: CarState) -> tuple[FloatArray, FloatArray]:
        """Advance the traffic by one control step; returns its poses (n, 6) before the step and
        their change over it (n, 6)."""
        if not self.traffic.count:
            return NO_TRAFFIC, NO_TRAFFIC
        old = self.traffic.poses()
        self.traffic.step(1.0 / self.frequency_hz, before.s, before.to_middle, before.speed)
        move = self.traffic.poses() - old
        move[:, 3:] = (move[:, 3:] + math.pi) % (2.0 * math.pi) - math.pi
        return old, move

    def _advance_car(self, others: FloatArray, move: FloatArray) -> Collision | None:
        """Advance the ego car by one control step while the traffic moves from `others` by `move`
        ((n, 6) each); returns what the ego car touched first."""
        steps, done = PHYSICS_HZ // self.frequency_hz, 0
        collision: Collision | None = None
        while done < steps:
            if not self._contacts.has_moving_wrecks:
                before, done = done, self._advance_free(others, move, done, steps)
                self._in_contact = self._in_contact and done == before
            if done < steps:
                share, dt = done / steps, 1.0 / self.frequency_hz
                touched = self._contacts.step(
                    self._motion, self._memory, self._controls, others, move, share, dt
                )
                collision, done = collision or touched, done + 1
                self._in_contact = True
        return collision

    def _advance_free(self, others: FloatArray, move: FloatArray, done: int, steps: int) -> int:
        """Advance from physics step `done` until the car touches something; returns the number of
        physics steps then done. A contact ends when the gap exceeds PyBullet's threshold."""
        return advance_free(
            self._params,
            self._other,
            self._table,
            self._ground,
            self._contacts.walls.arrays,
            self._motion,
            self._memory,
            self._controls,
            others,
            move,
            done,
            steps,
            CONTACT_MARGIN_M if self._in_contact else 0.0,
        )

    def _build_state(self, gear: int, collision: Collision | None) -> CarState:
        """The state of the ego car, from its motion and internal state."""
        measure_track_state(self._table, self._motion, self._memory, self._readings)
        motion, memory = self._motion.tolist(), self._memory.tolist()
        readings = self._readings.tolist()
        self._count_laps(readings[TRACK_S])
        return CarState(
            time_s=self._steps / self.frequency_hz,
            x=motion[0],
            y=motion[1],
            z=motion[2],
            yaw=readings[YAW],
            pitch=readings[PITCH],
            roll=readings[ROLL],
            vx=readings[VX],
            vy=readings[VY],
            yaw_rate=readings[YAW_RATE],
            s=readings[TRACK_S],
            to_middle=readings[TRACK_OFFSET],
            angle=readings[ANGLE],
            curvature=readings[TRACK_CURVATURE],
            rpm=memory[ENGINE] * RPM,
            gear=gear,
            wheel_spin=(memory[SPIN], memory[SPIN + 1], memory[SPIN + 2], memory[SPIN + 3]),
            steer=memory[STEER] / self.car.steering_lock,
            lap=self._lap,
            odometer_m=memory[ODOMETER],
            lap_time_s=(self._steps - self._lap_start) / self.frequency_hz,
            collision=collision,
            off_track=abs(readings[TRACK_OFFSET]) > self.road.edge,
            backwards=abs(readings[ANGLE]) > 0.5 * math.pi
            or readings[TRACK_SPEED] < BACKWARDS_SPEED_M_S,
        )

    def _count_laps(self, s: float) -> None:
        """Crossing the line adds a lap; crossing it backwards subtracts one."""
        length = self.road.track.length_m
        moved = s - self._s
        if moved < -0.5 * length:
            self._lap += 1
            self._lap_start = self._steps
        elif moved > 0.5 * length:
            self._lap -= 1
        self._s = s


def check_seed(seed: int) -> None:
    """Raises UserError unless `seed` is a non-negative integer."""
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise UserError(f"reset got seed = {seed!r}; give a whole number of 0 or more")


def _fill_controls(command: Command, controls: FloatArray) -> None:
    """Check `command` and write (steer, throttle, brake, gear) into `controls` (4,)."""
    steer, throttle, brake, gear = command.steer, command.throttle, command.brake, command.gear
    # Comparisons with NaN are false, so these hold for it as well.
    if not (-1.0 <= steer <= 1.0 and 0.0 <= throttle <= 1.0 and 0.0 <= brake <= 1.0):
        steer = clip_rounding(steer, -1.0, 1.0)
        throttle, brake = clip_rounding(throttle, 0.0, 1.0), clip_rounding(brake, 0.0, 1.0)
    if not (-1.0 <= steer <= 1.0 and 0.0 <= throttle <= 1.0 and 0.0 <= brake <= 1.0):
        raise UserError(
            f"the command has steer = {steer:.9g}, throttle = {throttle:.9g}, "
            f"brake = {brake:.9g}; steer goes from -1 to 1, the others go from 0 to 1"
        )
    if not LOWEST_GEAR <= gear <= HIGHEST_GEAR or gear != int(gear):
        raise UserError(f"the command has gear = {gear}; gears are -1, 0 and 1 to 6")
    controls[:] = steer, throttle, brake, gear
