"""Converts between records of the shared memory and Python objects. A record is a numpy row with
the fields of the block STATE or COMMAND of `layout`; `Values` are its fields by name."""

import math
from dataclasses import dataclass, fields
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from simulator.env.reward import Ending
from simulator.link.layout import Collision, Ended, Request
from simulator.vehicle.state import CarState, Command

_CODED: Final = ("collision", "off_track", "backwards")
_COUNTED: Final = ("number", "episode", "step", "late_steps", "seed", "reward", "score")
_PLAIN: Final = tuple(f.name for f in fields(CarState) if f.name not in _CODED)

Values = dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """A message of the server: the car's state, its sensors, reward and score."""

    number: int
    """Number of the message; a client can miss messages in real time."""
    episode: int
    step: int
    """Control steps since the reset."""
    late_steps: int
    seed: int
    state: CarState
    features: tf.TrackFeatures
    ranges: NDArray[np.float64]
    """Distances (19,) in m to the track's edge, from +90 to -90 deg; -1 off the track."""
    ranges_traffic: NDArray[np.float64]
    """Distances (19,) as `ranges`, but a beam also ends at a traffic car."""
    reward: float
    score: float
    ended: Ending | None
    image: NDArray[np.uint8] | None
    """Camera image (height, width, 3) RGB; None without a camera."""


def write_state(record: Any, state: CarState) -> None:
    """Write the car's state into `record`, a record of the block STATE."""
    for name in _PLAIN:
        record[name] = getattr(state, name)
    record["collision"] = Collision[(state.collision or "none").upper()]
    record["off_track"], record["backwards"] = state.off_track, state.backwards


def read_state(values: Values) -> CarState:
    """Return the car's state from `values`, the fields by name of a STATE record."""
    touched = Collision(values["collision"])
    return CarState(
        **{name: values[name] for name in _PLAIN if name != "wheel_spin"},
        wheel_spin=tuple(values["wheel_spin"].tolist()),
        collision=None if touched is Collision.NONE else cast(Any, touched.name.lower()),
        off_track=bool(values["off_track"]),
        backwards=bool(values["backwards"]),
    )


def write_features(record: Any, features: tf.TrackFeatures) -> None:
    """Write the track features into `record`, a record of the block STATE. Absent distances are
    NaN."""
    for name, value in features.distances.items():
        record[name] = math.nan if value is None else value
    centre = features.to_lane_centre
    record["to_lane_centre"] = math.nan if centre is None else centre
    record["heading"] = features.heading


def read_features(values: Values) -> tf.TrackFeatures:
    """Return the track features from `values`, the fields by name of a STATE record."""
    return tf.TrackFeatures(
        **{name: None if math.isnan(values[name]) else values[name] for name in tf.MARKINGS},
        angle=values["angle"],
        heading=tf.RoadClass(values["heading"]),
    )


def write_ending(record: Any, ending: Ending | None) -> None:
    record["ended"] = Ended[(ending or "not").upper()]


def read_ending(values: Values) -> Ending | None:
    ended = Ended(values["ended"])
    return None if ended is Ended.NOT else cast(Ending, ended.name.lower())


def read_message(record: Any, image: NDArray[np.uint8] | None) -> Message:
    """Return the message in the STATE record `record`, with its `image` (H, W, 3); both are
    copied."""
    # One tolist() reads all fields; reading each field separately takes ten times as long.
    values: Values = dict(zip(record.dtype.names, record.tolist(), strict=True))
    return Message(
        **{name: values[name] for name in _COUNTED},
        state=read_state(values),
        features=read_features(values),
        ranges=values["ranges"].copy(),
        ranges_traffic=values["ranges_traffic"].copy(),
        ended=read_ending(values),
        image=None if image is None else image.copy(),
    )


def write_command(record: Any, command: Command) -> None:
    """Write a step request with `command` into `record`, a record of the block COMMAND."""
    record["request"] = Request.STEP
    record["steer"], record["throttle"] = command.steer, command.throttle
    record["brake"], record["gear"] = command.brake, command.gear


def read_command(record: Any) -> Command:
    """Return the car's command in `record`, a record of the block COMMAND."""
    return Command(
        steer=float(record["steer"]),
        throttle=float(record["throttle"]),
        brake=float(record["brake"]),
        gear=int(record["gear"]),
    )
