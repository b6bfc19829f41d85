"""The simulated world: one ego car on one road with walls and traffic, stepped at 200 Hz.

Compiled code moves the ego car until it touches a wall or another car (`free_motion`). Then, and
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
from simulator.vehicle.dynamics import (
    ENGINE,
    MEMORY,
    MOTION,
    ODOMETER,
    PIECE,
    SPIN,
    STEER,
    make_work,
)
from simulator.vehicle.orientation import quaternion
from simulator.vehicle.powertrain import gear_ratio
from simulator.vehicle.state import CarState, Command
from simulator.vehicle.surface import ground
from simulator.vehicle.track_state import (
    ANGLE,
    PITCH,
    ROLL,
    TRACK_CURVATURE,
    TRACK_OFFSET,
    TRACK_S,
    TRACK_SPEED,
    VX,
    VY,
    YAW,
    YAW_RATE,
)
from simulator.world.collisions import CONTACT_MARGIN_M, ContactPhysics
from simulator.world.control_rate import PHYSICS_HZ, check_frequency
from simulator.world.control_step import advance_cars, measure_car
from simulator.world.fleet import (
    COLLISIONS,
    COMMAND_AT,
    DONE,
    IN_CONTACT,
    LAP,
    LAP_START,
    MEMORY_AT,
    MOTION_AT,
    SKIPPED,
    STEPS,
    TOUCHED,
    TRACK_AT,
    Fleet,
)
from simulator.world.free_motion import advance_free
from trackfeatures.errors import UserError

__all__ = ["CarState", "Command", "World"]

BACKWARDS_SPEED_M_S = -0.5
"""Below this speed (m/s) along the track, the car counts as driving backwards."""
MAX_START_SPEED_M_S = 150.0


class World:
    """A simulated car with its surroundings; `reset` starts an episode, `step` advances it by
    1/frequency_hz s.

    The ego car is car `number` of `fleet`, by default of its own fleet. A caller that steps a whole
    fleet calls `begin`, the compiled step, and `complete`; `step` does this for one car.
    """

    def __init__(
        self,
        road: Road,
        *,
        traffic: int = 0,
        frequency_hz: int = 20,
        car: CarParameters | None = None,
        fleet: Fleet | None = None,
        number: int = 0,
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
        self._fleet, self._number = fleet or Fleet(1), number
        walls = self._fleet.assign(number, road, self.car, traffic)
        self._row = self._fleet.cars[number]
        self._motion = self._row[MOTION_AT : MOTION_AT + MOTION]
        self._memory = self._row[MEMORY_AT : MEMORY_AT + MEMORY]
        self._controls = self._row[COMMAND_AT : COMMAND_AT + 4]
        self._work = make_work()
        self._contacts = ContactPhysics(road, self.car, walls)
        self._state: CarState | None = None
        self._state_step = 0.0
        self._started = self._closed = False

    @property
    def state(self) -> CarState:
        """The current state of the ego car. Raises UserError before the first reset."""
        if not self._started:
            raise UserError("the world has no episode yet; call reset(seed=...) first")
        if self._state is None or self._state_step != self._row[STEPS]:
            self._state, self._state_step = self._build_state(), float(self._row[STEPS])
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
        """Start an episode. `s` (m) defaults to 25 m before the start line; `angle` is track
        tangent minus yaw (rad, positive if the car points right); `speed` (m/s) is along the body.

        The episode depends only on the arguments, not on earlier episodes. Raises UserError for a
        value out of range.
        """
        if self._closed:
            raise UserError("this world is closed; make a new one")
        start = -START_BEFORE_LINE_M if s is None else float(s)
        check_seed(seed)
        check_place(self.road, start, to_middle, angle, speed)
        if self._traffic_count:
            self.traffic = Traffic(
                self.road, self._traffic_count, np.random.default_rng([seed, 1]), ego_s=start
            )
        self._contacts.start(self.traffic)
        self._place(start, to_middle, angle, speed)
        self._row[[STEPS, LAP, LAP_START, TOUCHED, IN_CONTACT]] = 0.0
        self._controls[:] = 0.0, 0.0, 0.0, 1.0
        self._row[TRACK_AT + TRACK_S] = start % self.road.track.length_m
        measure_car(self._table, self._row)
        self._state, self._started = None, True
        return self.state

    def step(self, command: Command) -> CarState:
        """Return the state after a control step. Raises UserError for an invalid `command`."""
        if not self._started:
            return self.state  # raises
        _fill_controls(command, self._controls)
        self.begin()
        number, steps = self._number, PHYSICS_HZ // self.frequency_hz
        advance_cars(number, number + 1, self._fleet.arrays, steps)
        if self._row[DONE] < steps:
            self.complete()
        return self.state

    def begin(self) -> None:
        """Begin a control step: move the traffic. If a car that was hit is still moving, set this
        car's value in the fleet's column SKIPPED: the compiled step then leaves this car alone."""
        self._row[TOUCHED] = self._row[DONE] = self._row[SKIPPED] = 0.0
        if self._traffic_count:
            self._advance_traffic(self.state)
            self._row[SKIPPED] = self._contacts.has_moving_wrecks

    def complete(self) -> None:
        """Complete a control step that the compiled code left incomplete, because the car touches
        something or drives among moving wrecks."""
        self._advance_in_contact()
        self._row[STEPS] += 1.0
        measure_car(self._table, self._row)

    def features(self) -> tf.TrackFeatures:
        """Return the true track features of the current state.

        Distances are horizontal, from the foot of the centre of gravity on the road plane.
        """
        now = self.state
        piece = int(self._memory[PIECE])
        offset = foot_offset(self._table, piece, now.s, now.to_middle, now.z)
        return self.road.measure(now.s, offset, now.angle)

    def body_pose(self) -> FloatArray:
        """Return x, y, z, roll, pitch, yaw (6,) of the centre of gravity (PyBullet's angles)."""
        now = self.state
        return np.array([now.x, now.y, now.z, now.roll, now.pitch, now.yaw])

    def close(self) -> None:
        """Release the physics client; afterwards `reset` and `step` raise UserError."""
        self._contacts.close()
        self._state, self._started, self._closed = None, False, True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _place(self, s: float, to_middle: float, angle: float, speed: float) -> None:
        """Place the car on its wheels at (s, to_middle) m, `angle` rad, rolling at `speed` m/s."""
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

    def _advance_traffic(self, before: CarState) -> None:
        """Advance the traffic by one control step, and write its poses (n, 6) before the step and
        their change over it (n, 6) into the fleet."""
        old = self.traffic.poses()
        self.traffic.step(1.0 / self.frequency_hz, before.s, before.to_middle, before.speed)
        move = self.traffic.poses() - old
        move[:, 3:] = (move[:, 3:] + math.pi) % (2.0 * math.pi) - math.pi
        self._fleet.others[self._number, : len(old)] = old
        self._fleet.move[self._number, : len(old)] = move

    def _advance_in_contact(self) -> None:
        """Do the rest of a control step: PyBullet computes contacts, compiled code computes the
        motion between contacts. Stores what the car touched first."""
        steps, done = PHYSICS_HZ // self.frequency_hz, int(self._row[DONE])
        others = self._fleet.others[self._number, : self._traffic_count]
        move = self._fleet.move[self._number, : self._traffic_count]
        while done < steps:
            share, dt = done / steps, 1.0 / self.frequency_hz
            touched = self._contacts.step(
                self._motion, self._memory, self._controls, others, move, share, dt
            )
            self._row[TOUCHED] = self._row[TOUCHED] or COLLISIONS.index(touched)
            self._row[IN_CONTACT], done = 1.0, done + 1
            if not self._contacts.has_moving_wrecks:
                before, done = done, self._advance_free(others, move, done, steps)
                self._row[IN_CONTACT] = done == before
        self._row[DONE] = done

    def _advance_free(self, others: FloatArray, move: FloatArray, done: int, steps: int) -> int:
        """Advance from physics step `done`, in contact, until the car touches something; returns
        the number of physics steps then done. A contact ends when the gap exceeds PyBullet's
        threshold."""
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
            CONTACT_MARGIN_M,
            self._work,
        )

    def _build_state(self) -> CarState:
        """Build the state of the ego car from its row."""
        row = self._row.tolist()
        motion, memory, track = row[MOTION_AT:], row[MEMORY_AT:], row[TRACK_AT:]
        return CarState(
            time_s=int(row[STEPS]) / self.frequency_hz,
            x=motion[0],
            y=motion[1],
            z=motion[2],
            yaw=track[YAW],
            pitch=track[PITCH],
            roll=track[ROLL],
            vx=track[VX],
            vy=track[VY],
            yaw_rate=track[YAW_RATE],
            s=track[TRACK_S],
            to_middle=track[TRACK_OFFSET],
            angle=track[ANGLE],
            curvature=track[TRACK_CURVATURE],
            rpm=memory[ENGINE] * RPM,
            gear=int(row[COMMAND_AT + 3]),
            wheel_spin=(memory[SPIN], memory[SPIN + 1], memory[SPIN + 2], memory[SPIN + 3]),
            steer=memory[STEER] / self.car.steering_lock,
            lap=int(row[LAP]),
            odometer_m=memory[ODOMETER],
            lap_time_s=int(row[STEPS] - row[LAP_START]) / self.frequency_hz,
            collision=COLLISIONS[int(row[TOUCHED])],
            off_track=abs(track[TRACK_OFFSET]) > self.road.edge,
            backwards=abs(track[ANGLE]) > 0.5 * math.pi or track[TRACK_SPEED] < BACKWARDS_SPEED_M_S,
        )


def check_place(
    road: Road, s: float = 0.0, to_middle: float = 0.0, angle: float = 0.0, speed: float = 0.0
) -> None:
    """Raises UserError unless `World.reset` accepts these start values (m, m, rad, m/s)."""
    for name, value in (("s", s), ("to_middle", to_middle), ("angle", angle)):
        if not math.isfinite(value):
            raise UserError(f"reset got {name} = {value}; give a finite number")
    if not abs(speed) <= MAX_START_SPEED_M_S:  # true for NaN, too
        raise UserError(f"reset got speed = {speed}; give m/s between -150 and 150")
    if abs(to_middle) > road.edge:
        raise UserError(
            f"reset got to_middle = {to_middle} m; the road ends {road.edge:.2f} m from its "
            "centre, so give less"
        )


def check_seed(seed: int) -> None:
    """Raises UserError unless `seed` is a non-negative integer."""
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise UserError(f"reset got seed = {seed!r}; give a whole number of 0 or more")


def _fill_controls(command: Command, controls: FloatArray) -> None:
    """Check `command` and write (steer, throttle, brake, gear) into `controls` (4,)."""
    steer, throttle, brake, gear = command.steer, command.throttle, command.brake, command.gear
    # Comparisons with NaN are false, so NaN is treated as out of range.
    if not (-1.0 <= steer <= 1.0 and 0.0 <= throttle <= 1.0 and 0.0 <= brake <= 1.0):
        steer = clip_rounding(steer, -1.0, 1.0)
        throttle, brake = clip_rounding(throttle, 0.0, 1.0), clip_rounding(brake, 0.0, 1.0)
    if not (-1.0 <= steer <= 1.0 and 0.0 <= throttle <= 1.0 and 0.0 <= brake <= 1.0):
        raise UserError(
            f"the command has steer = {steer:.9g}, throttle = {throttle:.9g}, "
            f"brake = {brake:.9g}; steer goes from -1 to 1, throttle and brake go from 0 to 1"
        )
    if not LOWEST_GEAR <= gear <= HIGHEST_GEAR or gear != int(gear):
        raise UserError(f"the command has gear = {gear}; gears are -1, 0 and 1 to 6")
    controls[:] = steer, throttle, brake, gear
