"""The parameters of a car (SI units; body frame x forward, y left, z up).

The defaults describe TORCS's car1-trb1, the car of the paper's experiments. The mass and the axle
distances (lf, lr) are also the paper's. Two values differ from the paper. The paper's yaw inertia
(2000 kg m2) and cornering stiffness (80 kN/rad per tyre) belong to the model of its controllers
(`controllers.laws.lateral_model`). The recorded TORCS laps of this car show 1120 kg m2 and 125
kN/rad. With the paper's values, the simulated car's largest distance from the middle of g-track-3,
in its kink, is twice as large.
"""

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

GRAVITY = 9.81  # m/s2
RPM = 60.0 / (2.0 * np.pi)  # factor from rad/s to rev/min
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
TORQUE_RPM_STEP = 1000.0  # rev/min between two entries of the torque table, which starts at 0
LOWEST_GEAR, HIGHEST_GEAR = -1, 6  # -1 reverse, 0 neutral


@dataclass(frozen=True)
class CarParameters:
    """The parameters of one car; the defaults are TORCS's car1-trb1 (see the module's docstring).

    Raises UserError for a value that is not positive, or a torque table of the wrong length.
    """

    mass: float = 1150.0
    """Mass without fuel, kg."""
    fuel: float = 80.0
    """Mass of the fuel, kg; constant, at the centre of gravity."""
    inertia: tuple[float, float, float] = (477.0, 868.0, 1113.0)
    """Moments of inertia about x (roll), y (pitch) and z (yaw), kg m2. They are the moments of a
    box of the car's size, with TORCS's mass repartition coefficient of 0.62 on its length."""
    front_axle: float = 1.27
    """Distance from the centre of gravity to the front axle, lf, m."""
    rear_axle: float = 1.37
    """Distance from the centre of gravity to the rear axle, lr, m."""
    front_track: float = 1.68
    rear_track: float = 1.60
    cg_height: float = CameraParameters.cg_height_m
    """Height of the centre of gravity above the road at rest, m."""
    length: float = 4.52
    width: float = 1.94
    height: float = 1.10

    spring_front: float = 150_000.0
    """Spring stiffness at a front wheel, N/m."""
    spring_rear: float = 150_000.0
    damper_front: float = 7_000.0
    """Damper constant at a front wheel, N s/m."""
    damper_rear: float = 7_000.0
    anti_roll_front: float = 20_000.0
    """Force per difference in compression between the two front wheels, N/m."""
    anti_roll_rear: float = 10_000.0
    bump_travel: float = 0.08
    """Compression beyond rest at which the bump stop begins to act, m."""
    bump_spring: float = 600_000.0
    """Stiffness (N/m) of the bump stop; it adds to the stiffness of the spring."""

    wheel_radius: float = 0.3273
    wheel_inertia: float = 1.2
    """Moment of inertia of one wheel, kg m2."""
    friction: float = 1.6
    """Ratio of largest tyre force to load, at `working_load`, on a surface with grip 1."""
    tyre_stiffness: float = 20.0
    """Slope of the tyre force at zero slip divided by the largest force, 1/rad (Pacejka's B C)."""
    tyre_shape: float = 1.41
    """Factor C of the magic formula (Pacejka, Tyre and Vehicle Dynamics, 4.3.1)."""
    tyre_curvature: float = 0.7
    """Factor E of the magic formula."""
    camber_gain_front: float = 1.048
    """Factor of the front wheels' camber (4 deg) on the friction: 1 + 0.05 sin(18 camber)."""
    camber_gain_rear: float = 1.040
    """Factor of the rear wheels' camber (3 deg) on the friction."""
    working_load: float = 1.2
    """Ratio of the load with nominal friction to the static load without fuel."""
    friction_unloaded: float = 1.6
    """Ratio of friction at zero load to nominal friction. With increasing load the friction falls
    exponentially."""
    friction_overloaded: float = 0.8
    """Ratio of friction at infinite load to nominal friction."""
    rolling_resistance: float = 0.001
    """Ratio of rolling resistance force to load, on asphalt."""

    steering_lock: float = 0.36652
    """Angle of the front wheels at steer = 1, rad (21 deg)."""
    steering_rate: float = 6.2832
    """Largest angular speed of the front wheels' steering, rad/s (360 deg/s)."""

    air_density: float = 1.23
    drag_coefficient: float = 0.35
    frontal_area: float = 1.92
    wing_drag: float = 0.47
    """Drag coefficient times area of the wings, m2."""
    lift_front: float = 1.79
    """Downforce coefficient times area of wing and ground effect at the front axle, m2."""
    lift_rear: float = 2.96

    gears: tuple[float, float, float, float, float, float] = (3.0, 1.9, 1.4, 1.1, 0.9, 0.77)
    reverse_gear: float = -4.0
    final_drive: float = 4.5
    driveline_efficiency: float = 0.984
    engine_inertia: float = 0.02
    """Inertia at the crankshaft, kg m2; fitted to TORCS's 6.3 % larger effective mass in gear 1."""
    idle_rpm: float = 900.0
    limiter_rpm: float = 9152.0
    """Engine speed (rev/min) above which the engine in gear gives no driving and no braking
    torque."""
    top_rpm: float = 10_000.0
    """Engine speed (rev/min) at the end of the torque table. In gear the engine never exceeds this
    speed."""
    torque: tuple[float, ...] = (
        100.0, 160.0, 190.0, 280.0, 350.0, 405.0, 443.0, 465.0, 483.0, 415.0, 360.0,
    )  # fmt: skip
    """Torque at full throttle at 0, 1000, ... 10000 rev/min, N m."""
    engine_braking: float = 0.33
    """Ratio of braking torque at closed throttle to full-load torque, at `top_rpm`; 0 at idle."""
    differential_viscosity: float = 30.0
    """Torque of the differential per speed difference of the two rear wheels, N m s/rad."""

    brake_torque: float = 9_000.0
    """Torque at full brake, sum of the four wheels, N m; it is enough to lock the wheels."""
    brake_front_share: float = 0.58

    def __post_init__(self) -> None:
        for name in ("mass", "front_axle", "rear_axle", "cg_height", "wheel_radius", "friction"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise UserError(f"car parameter {name} is {value}; give a number above 0")
        if len(self.torque) != 11:
            raise UserError(
                f"the torque table has {len(self.torque)} values; give 11, at 0, 1000 ... 10000 rpm"
            )

    @property
    def total_mass(self) -> float:
        return self.mass + self.fuel

    @property
    def wheelbase(self) -> float:
        return self.front_axle + self.rear_axle

    @property
    def static_loads(self) -> tuple[float, float]:
        """Load (N) of one front and of one rear tyre, at rest on a level road."""
        half_weight = 0.5 * self.total_mass * GRAVITY
        return (
            half_weight * self.rear_axle / self.wheelbase,
            half_weight * self.front_axle / self.wheelbase,
        )

    def cornering_stiffness(self, front: bool, grip: float) -> float:
        """Return the cornering stiffness (N/rad) of one front or rear tyre at static load; `grip`
        is the surface's factor on the friction coefficient."""
        load = self.static_loads[0 if front else 1]
        share = load / (self.working_load * load * self.mass / self.total_mass)
        spread = self.friction_unloaded - self.friction_overloaded
        rate = np.log((1.0 - self.friction_overloaded) / spread)
        nominal = self.friction_overloaded + spread * np.exp(rate * share)
        gain = self.camber_gain_front if front else self.camber_gain_rear
        return float(self.tyre_stiffness * self.friction * nominal * gain * grip * load)

    def packed(self) -> NDArray[Any]:
        """Return the parameters and values derived from them as an array (1,) for compiled code."""
        values = [getattr(self, field.name) for field in fields(self)]
        layout = [
            (field.name, "f8", (len(value),) if isinstance(value, tuple) else ())
            for field, value in zip(fields(self), values, strict=True)
        ]
        layout += [(name, "f8", ()) for name in ("total_mass", "load_front", "load_rear")]
        layout += [(name, "f8", ()) for name in ("working_front", "working_rear")]
        layout += [(name, "f8", ()) for name in ("friction_rate", "tyre_slope")]
        front, rear = self.static_loads
        nominal = self.working_load * self.mass / self.total_mass
        spread = self.friction_unloaded - self.friction_overloaded
        rate = math.log((1.0 - self.friction_overloaded) / spread)
        slope = self.tyre_stiffness / self.tyre_shape
        derived = (self.total_mass, front, rear, nominal * front, nominal * rear, rate, slope)
        return np.array([(*values, *derived)], dtype=layout)
