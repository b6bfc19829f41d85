"""Builds the `info` of a vector environment in the form in which Gymnasium combines the cars'
`info`."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulator.env.cars import FEATURES, Cars
from simulator.env.control_step import DISTANCES_AT, ENDED, HEADING, SCORE
from simulator.env.reward import ENDINGS
from simulator.vehicle.car import RPM
from simulator.vehicle.dynamics import ENGINE
from simulator.vehicle.track_state import ANGLE, TRACK_OFFSET, TRACK_S, VX, VY
from simulator.world.fleet import COLLISIONS, LAP, LAP_START, MEMORY_AT, STEPS, TOUCHED, TRACK_AT

_COLLISIONS = np.array([name or "" for name in COLLISIONS], object)
_ENDINGS = np.array(["", *ENDINGS], object)


def vector_info(cars: Cars, frequency_hz: int, chosen: NDArray[np.bool_]) -> dict[str, Any]:
    """Return an array (N,) for each entry of a car's `info`. For each entry, a boolean array (N,)
    under the entry's name with a leading underscore marks the cars whose value is valid: the
    `chosen` cars (N,), except where a feature is absent."""
    rows, results = cars.fleet.cars, cars.results
    track = rows[:, TRACK_AT:]
    steps = rows[:, STEPS].astype(int)
    speed = np.array(list(map(math.hypot, track[:, VX].tolist(), track[:, VY].tolist())))
    columns = {
        "score": results[:, SCORE],
        "steps": steps,
        "time_s": steps / frequency_hz,
        "lap": rows[:, LAP].astype(int),
        "lap_time_s": (rows[:, STEPS] - rows[:, LAP_START]) / frequency_hz,
        "s": track[:, TRACK_S],
        "to_middle": track[:, TRACK_OFFSET],
        "angle": track[:, ANGLE],
        "speed_kmh": 3.6 * np.where(track[:, VX] >= 0.0, speed, -speed),
        "rpm": rows[:, MEMORY_AT + ENGINE] * RPM,
        "collision": _COLLISIONS[rows[:, TOUCHED].astype(int)],
        "ended": _ENDINGS[results[:, ENDED].astype(int)],
    }
    info: dict[str, Any] = {}
    everyone = bool(chosen.all())
    for name, column in columns.items():
        _add(info, name, column, chosen, everyone)
    features: dict[str, Any] = {}
    found = ~np.isnan(results[:, DISTANCES_AT:HEADING]) & chosen[:, np.newaxis]
    counts = np.count_nonzero(found, axis=0).tolist()
    for k, name in enumerate(FEATURES):
        if counts[k]:
            column = results[:, DISTANCES_AT + k]
            _add(features, name, column, found[:, k], counts[k] == len(found))
    _add(features, "angle", track[:, ANGLE], chosen, everyone)
    _add(features, "heading", results[:, HEADING].astype(int), chosen, everyone)
    return info | {"features": features, "_features": chosen.copy()}


def _add(
    info: dict[str, Any],
    name: str,
    column: NDArray[Any],
    present: NDArray[np.bool_],
    everyone: bool,
) -> None:
    """Add `column` (N,) to `info` as the entry `name`, and the mask `present` (N,) of the cars that
    have the entry. Cars without it get 0, or None in a column of objects. `everyone` is true if all
    cars have the entry."""
    absent: Any = None if column.dtype == object else 0
    info[name] = column.copy() if everyone else np.where(present, column, absent)
    info[f"_{name}"] = present.copy()
