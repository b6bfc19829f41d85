"""Units of TORCS parameter files, by the rules of TORCS 1.3.7: names, factors and their products.

A unit is a product of names: "." multiplies, "/" divides by everything after it, and "2" squares
the name before it, as in "kg.m/s2". TORCS reads an unknown name, such as "yard" or "Deg", as 1;
here it raises an error.
"""

import math
import re
from dataclasses import dataclass
from typing import Final

Dimension = tuple[int, int, int]
"""Powers of metre, kilogram and second; all are 0 for an angle and a percentage."""

RATIO: Final = (0, 0, 0)
LENGTH: Final = (1, 0, 0)
_MASS, _TIME, _PRESSURE, _FORCE = (0, 1, 0), (0, 0, 1), (-1, 1, -2), (1, 1, -2)
_GRAVITY: Final = 9.80665
_POUND: Final = 0.45359237


@dataclass(frozen=True)
class Unit:
    """Factor that converts a unit to SI units, and the unit's dimension."""

    factor: float
    dimension: Dimension = RATIO


def _named(*names: str, factor: float = 1.0, dimension: Dimension = RATIO) -> dict[str, Unit]:
    return dict.fromkeys(names, Unit(factor, dimension))


UNITS: Final = {
    **_named("m", dimension=LENGTH),
    **_named("km", factor=1000.0, dimension=LENGTH),
    **_named("cm", factor=0.01, dimension=LENGTH),
    **_named("mm", factor=0.001, dimension=LENGTH),
    # These are TORCS's factors; exact: foot 0.3048 m, slug 14.593903 kg, psi 6894.757 Pa.
    **_named("ft", "feet", factor=0.304801, dimension=LENGTH),
    **_named("in", "inch", "inches", factor=0.0254, dimension=LENGTH),
    **_named("rad"),
    **_named("deg", factor=math.pi / 180.0),
    **_named("%", "percent", factor=0.01),
    **_named("s", dimension=_TIME),
    **_named("h", "hour", "hours", factor=3600.0, dimension=_TIME),
    **_named("day", "days", factor=86_400.0, dimension=_TIME),
    **_named("kg", dimension=_MASS),
    **_named("lb", "lbs", factor=_POUND, dimension=_MASS),
    **_named("slug", "slugs", factor=14.59484546, dimension=_MASS),
    **_named("N", dimension=_FORCE),
    **_named("lbf", factor=_POUND * _GRAVITY, dimension=_FORCE),
    **_named("Pa", dimension=_PRESSURE),
    **_named("kPa", factor=1e3, dimension=_PRESSURE),
    **_named("MPa", factor=1e6, dimension=_PRESSURE),
    **_named("psi", "PSI", factor=6894.76, dimension=_PRESSURE),
    **_named("rpm", "RPM", factor=0.104719755, dimension=(0, 0, -1)),
    **_named("mph", "MPH", factor=0.44704, dimension=(1, 0, -1)),
}
ANY: Final = ("", "none", "SI")
"""Texts for "no unit"; the number is used unchanged, as a value in SI units."""

_PART: Final = re.compile(r"([^./2]*)([./2]|$)")


def parse_unit(text: str) -> Unit | None:
    """Return the unit that `text` names, or None if `text` stands for no unit ("", "none" or "SI").
    Raises KeyError for an unknown unit name."""
    text = text.strip()
    if text in ANY:
        return None
    factor, dimension, sign = 1.0, [0, 0, 0], 1
    for name, mark in _PART.findall(text):
        unit = UNITS[name] if name else Unit(1.0)
        power = 2 * sign if mark == "2" else sign
        factor *= unit.factor**power
        dimension = [a + power * b for a, b in zip(dimension, unit.dimension, strict=True)]
        if mark == "/":
            sign = -1
    return Unit(factor, (dimension[0], dimension[1], dimension[2]))
