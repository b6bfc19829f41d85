"""Checks the start of an episode, which the options of `reset` set."""

from collections.abc import Mapping
from typing import Any

from simulator.bounds import clip_rounding
from simulator.track.road import Road
from simulator.world.world import MAX_START_SPEED_M_S
from trackfeatures.errors import UserError

OPTIONS = ("s", "to_middle", "angle", "speed")


def reset_options(options: Any) -> dict[str, Any]:
    """Return the options of `reset` as a dict. Raises UserError unless they are a dict or None."""
    if options is not None and not isinstance(options, Mapping):
        raise UserError(f"options is {options!r}; give a dict, or None")
    return dict(options or {})


def check_start(options: Mapping[str, Any], road: Road) -> dict[str, float]:
    """Convert `options` to the arguments of `World.reset`, as floats. Values beyond their bounds by
    no more than float32 rounding are clipped; options that are None are left out.

    Raises UserError for an unknown option or a value that is not a number.
    """
    unknown = sorted(str(name) for name in options if name not in OPTIONS)
    if unknown:
        raise UserError(f"reset got the unknown options {unknown}; it takes {OPTIONS}")
    start = {name: _number(name, value) for name, value in options.items() if value is not None}
    for name, bound in (("to_middle", road.edge), ("speed", MAX_START_SPEED_M_S)):
        if name in start:
            start[name] = clip_rounding(start[name], -bound, bound)
    return start


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise UserError(f"reset got {name} = {value!r}; give a number") from None
