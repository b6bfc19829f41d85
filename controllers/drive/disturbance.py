"""Disturbances of a drive: sensor noise, delay, wind, and changed parameters of the car. SI units.

A disturbance depends only on the seed of the drive, so that all controllers drive under the same
disturbance (paired seeds).
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from controllers.interface import Controller, Observation
from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.track.road import Road
from simulator.vehicle.car import CarParameters
from simulator.vehicle.state import CarState, Command
from simulator.world.world import World
from trackfeatures.errors import UserError

OFFSET_NOISE_M, ANGLE_NOISE_RAD = 0.05, 0.005
SPEED_NOISE_M_S, YAW_RATE_NOISE_RAD_S = 0.1, 0.01
"""Standard deviations of the noise on the offset, the angle, the speeds vx and vy, and the yaw rate
of an observation. Each control step has new random noise."""
NOISE_STD = np.array(
    (OFFSET_NOISE_M, ANGLE_NOISE_RAD, SPEED_NOISE_M_S, SPEED_NOISE_M_S, YAW_RATE_NOISE_RAD_S)
)
"""Standard deviations of the noise on offset (m), angle (rad), vx and vy (m/s), and yaw rate
(rad/s), as an array."""
DELAY_S = 0.1
"""Delay (s) of the perception."""
GUST_M_S, GUST_S = 6.0, 1.5
"""Standard deviation (m/s) and correlation time (s) of the side wind, a Gauss-Markov process."""
SIDE_FORCE_M2 = 4.5
"""Slope of the side force coefficient (2.3 / rad) times the frontal area (m2). The side force (N)
is half of this product times air density (kg/m3), wind speed and driving speed (m/s)."""
AIR_DENSITY = CarParameters.air_density
FRICTION = (0.8, 1.6)
"""Range of the tyres' friction coefficient of a disturbed car."""
SPREAD = 0.2
"""Largest relative deviation of a disturbed car's mass and tyre stiffness from their defaults."""


@dataclass(frozen=True)
class Disturbance:
    """The kinds of disturbance that act on a drive; by default none acts."""

    noise: bool = False
    delay_s: float = 0.0
    """Delay of the perception, s; the state is not predicted over this delay."""
    wind: bool = False
    friction: bool = False
    mass: bool = False
    stiffness: bool = False

    def car(self, seed: int) -> CarParameters:
        """Return the car's parameters. The disturbed parameters are random and depend only on
        `seed`."""
        rng, car = np.random.default_rng([seed, 5]), CarParameters()
        low, high = FRICTION
        friction = rng.uniform(low, high)
        mass, stiffness = rng.uniform(1.0 - SPREAD, 1.0 + SPREAD, 2)
        if self.friction:
            # The slope at zero slip, tyre_stiffness * friction, stays the same.
            stiffer = car.tyre_stiffness * car.friction / friction
            car = replace(car, friction=friction, tyre_stiffness=stiffer)
        if self.mass:
            ix, iy, iz = car.inertia
            inertia = (ix * mass, iy * mass, iz * mass)
            car = replace(car, mass=car.mass * mass, inertia=inertia)
        if self.stiffness:
            car = replace(car, tyre_stiffness=car.tyre_stiffness * stiffness)
        return car

    def world(self, road: Road, *, traffic: int, frequency_hz: int, seed: int) -> World:
        """Return a world whose car is `car(seed)`, with side wind if `wind` is set.

        `traffic` is the number of other cars, `frequency_hz` the number of control steps per
        second.
        """
        car = self.car(seed)
        if self.wind:
            gusts = self.gusts(1.0 / frequency_hz, seed)
            return WindyWorld(road, gusts, traffic=traffic, frequency_hz=frequency_hz, car=car)
        return World(road, traffic=traffic, frequency_hz=frequency_hz, car=car)

    def controller(self, controller: Controller, seed: int) -> Controller:
        """Return `controller`. If `noise` is set, errors that depend on `seed` are added to each
        observation that it receives."""
        if not self.noise:
            return controller
        return NoisySensors(controller, self.noise_rng(seed))

    def gusts(self, dt: float, seed: int) -> "Gusts":
        """Return the random side wind that belongs to `seed`, for control steps of `dt` s."""
        return Gusts(dt, np.random.default_rng([seed, 4]))

    def noise_rng(self, seed: int) -> np.random.Generator:
        """Return the random generator of the sensor noise. A step takes five standard normal
        numbers from the generator and multiplies them by NOISE_STD (offset, angle, vx, vy, yaw
        rate)."""
        return np.random.default_rng([seed, 6])


UNDISTURBED = "none"
DISTURBANCES: dict[str, Disturbance] = {
    UNDISTURBED: Disturbance(),
    "noise": Disturbance(noise=True),
    "delay": Disturbance(delay_s=DELAY_S),
    "wind": Disturbance(wind=True),
    "friction": Disturbance(friction=True),
    "mass": Disturbance(mass=True),
    "stiffness": Disturbance(stiffness=True),
}


def find_disturbance(name: str) -> Disturbance:
    """Return the disturbance called `name`. Raises UserError for an unknown name."""
    if name not in DISTURBANCES:
        known = ", ".join(DISTURBANCES)
        raise UserError(f"there is no disturbance {name!r}; use one of: {known}")
    return DISTURBANCES[name]


class NoisySensors:
    """A controller whose observations have normally distributed errors."""

    def __init__(self, controller: Controller, rng: np.random.Generator) -> None:
        self._controller, self._rng = controller, rng

    def update(self, observation: Observation) -> float:
        errors = (NOISE_STD * self._rng.normal(size=5)).tolist()
        return self._controller.update(
            replace(
                observation,
                to_lane_centre=observation.to_lane_centre + errors[0],
                angle=observation.angle + errors[1],
                vx=observation.vx + errors[2],
                vy=observation.vy + errors[3],
                yaw_rate=observation.yaw_rate + errors[4],
            )
        )


class Gusts:
    """Side wind (m/s, positive from the right); `step` returns the value of the next control step
    of `dt` s."""

    def __init__(self, dt: float, rng: np.random.Generator) -> None:
        self._keep = math.exp(-dt / GUST_S)
        self._rng = rng
        self._wind = 0.0

    def step(self) -> float:
        share = math.sqrt(1.0 - self._keep**2)
        self._wind = self._keep * self._wind + share * GUST_M_S * float(self._rng.normal())
        return self._wind


class WindyWorld(World):
    """A world with side wind, whose force acts at the centre of gravity once per control step."""

    def __init__(
        self, road: Road, gusts: Gusts, *, traffic: int, frequency_hz: int, car: CarParameters
    ) -> None:
        super().__init__(road, traffic=traffic, frequency_hz=frequency_hz, car=car)
        self._gusts = gusts

    def step(self, command: Command) -> CarState:
        now, wind = self.state, self._gusts.step()
        push(self._motion, now.yaw, now.vx, wind, self.car.total_mass, self.frequency_hz)
        return super().step(command)


@compiled
def push(
    motion: FloatArray, yaw: float, vx: float, wind: float, mass: float, frequency_hz: int
) -> None:
    """Add the effect of a side `wind` (m/s, positive from the right) over a control step of 1 /
    `frequency_hz` s to the car's velocity. The velocity is part of the car's motion state `motion`
    (13,) in the world frame, which is changed in place.

    The car has the mass `mass` (kg), the yaw `yaw` (rad) and the forward speed `vx` (m/s).
    """
    change = AIR_DENSITY * SIDE_FORCE_M2 * wind * abs(vx) * 0.5 / mass / frequency_hz
    motion[7] -= change * math.sin(yaw)
    motion[8] += change * math.cos(yaw)
