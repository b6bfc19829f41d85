"""Options of the environments: road, traffic, car and controls."""

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

import trackfeatures as tf
from simulator.bounds import check_whole
from simulator.env.action import Controls, check_controls
from simulator.env.observation import ObservationOptions
from simulator.env.reward import EpisodeOptions
from simulator.env.start import OPTIONS as START_OPTIONS
from simulator.env.view_renderer import RenderOptions
from simulator.track.random_roads.road import RANDOM
from simulator.vehicle.car import CarParameters
from simulator.world.control_rate import check_frequency
from trackfeatures.errors import UserError

Setting = float | tuple[float, float]
"""A number, or a range (least, greatest) from which each episode draws a random number."""


@dataclass(frozen=True)
class DriveOptions:
    """Options for road, traffic, car and controls. Raises UserError for a bad option."""

    track: str = "circuit"
    """Name of a track, a file, or "random": each episode drives on one of 256 random roads."""

    lanes: int | tuple[int, int] = 1
    lane_width: Setting | None = None
    """Width of a lane, m; a random number from a range is rounded to 0.1 m. None: 4.0, or the
    random width of a varied road."""
    roads: str = "paper"
    """"paper", or "varied": lane width, shoulders and lines are random by `road_seed`, the look by
    `light_seed`."""
    road_seed: int = 0
    traffic: int = 0
    """Number of other cars, 0 to 12."""

    friction: Setting = 1.0
    """Factor on the tyres' friction coefficient."""
    mass: Setting = 1.0
    """Factor on the car's mass without fuel and on its inertia."""
    start: Mapping[str, Setting] = field(default_factory=dict)
    """Start of each episode, as in `reset(options=...)`; options given to `reset` have priority."""

    frequency_hz: int = 20
    """Control steps per second; a divisor of 200 Hz, the rate of the physics."""

    controls: Controls = "steer"
    """"steer": steering only, at throttle 0.2 in gear 1; "full": steering, throttle, brake and
    gear."""

    tracks_dir: str | Path | None = None
    """Additional folder in which tracks are searched."""

    def __post_init__(self) -> None:
        check_controls(self.controls)
        check_frequency(check_whole("frequency_hz", self.frequency_hz, 1))
        check_whole("road_seed", self.road_seed)
        if not isinstance(self.track, str):
            raise UserError(f'track is {self.track!r}; give a name, a file, or "{RANDOM}", as text')
        for name in ("friction", "mass"):
            for value in ends_of(name, getattr(self, name)):
                if not value > 0.0:
                    raise UserError(f"{name} is {value:g}; give a factor above 0")
        numbers: Any = self.lanes if isinstance(self.lanes, tuple) else (self.lanes,)
        if isinstance(self.lanes, tuple):
            ends_of("lanes", self.lanes)
        for lanes in numbers:
            tf.check_lanes(lanes, tf.LANE_WIDTH_M)
        if self.lane_width is not None:
            for width in ends_of("lane_width", self.lane_width):
                tf.check_lanes(1, width)
        if not isinstance(self.start, Mapping):
            raise UserError(f"start is {self.start!r}; give a dict of {', '.join(START_OPTIONS)}")
        for name, setting in self.start.items():
            if name not in START_OPTIONS:
                raise UserError(f"start has {name!r}; it takes {', '.join(START_OPTIONS)}")
            ends_of(name, setting)

    def car(self, rng: np.random.Generator | None) -> CarParameters:
        """Return the car of an episode. Where `friction` or `mass` is a range, the value is a
        random number from `rng`, or the least value if `rng` is None."""
        friction, mass = draw(self.friction, rng), draw(self.mass, rng)
        car = CarParameters()
        if friction == mass == 1.0:
            return car
        x, y, z = car.inertia
        return replace(
            car,
            friction=car.friction * friction,
            mass=car.mass * mass,
            inertia=(x * mass, y * mass, z * mass),
        )


OPTIONS = (DriveOptions, EpisodeOptions, ObservationOptions, RenderOptions)


def split_options(
    given: dict[str, Any],
) -> tuple[DriveOptions, EpisodeOptions, ObservationOptions, RenderOptions]:
    """Split the keyword arguments `given` into four groups of options. Raises UserError for unknown
    names."""
    names = [field.name for group in OPTIONS for field in fields(group)]
    for name in given:
        if name not in names:
            close = difflib.get_close_matches(name, names, 1)
            hint = f"did you mean {close[0]!r}?" if close else f"it takes {', '.join(names)}"
            raise UserError(f"the environment has no option {name!r}; {hint}")
    drive, episode, observation, picture = (
        {field.name: given[field.name] for field in fields(group) if field.name in given}
        for group in OPTIONS
    )
    return (
        DriveOptions(**drive),
        EpisodeOptions(**episode),
        ObservationOptions(**observation),
        RenderOptions(**picture),
    )


def draw(setting: Any, rng: np.random.Generator | None) -> Any:
    """Return the number of a setting: the number itself, or a random number from its range (the
    least value without `rng`)."""
    if not isinstance(setting, tuple):
        return setting
    return setting[0] if rng is None else float(rng.uniform(*setting))


def ends_of(name: str, setting: Any) -> tuple[float, ...]:
    """Return both ends of the range `setting`. If `setting` is a number, it is both ends. Raises
    UserError, which contains `name`, for anything else."""
    given = setting if isinstance(setting, tuple) else (setting, setting)
    try:
        ends = tuple(float(value) for value in given)
    except (TypeError, ValueError):
        ends = ()
    if len(ends) != 2 or not all(map(math.isfinite, ends)) or ends[0] > ends[1]:
        raise UserError(
            f"{name} is {setting!r}; give a finite number, or a range (least, greatest)"
        )
    return ends
