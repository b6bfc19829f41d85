"""Draws random values from a TOML file of ranges; `ranges.toml` explains the notation.

The values of a section are drawn in the order of the file, so the same generator gives the same
values.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.resources import files
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

Tables = Mapping[str, Mapping[str, Any]]
Values = dict[str, Any]
Kind = TypeVar("Kind")

SECTIONS = ("lanes", "camera", "lines", "paint", "surface", "roadside", "light", "lens", "cabin")
"""Sections of ranges.toml. The index seeds a section's generator: append, do not reorder."""
STREAM = 20
"""Part of the seed of the generators of varied roads; scenery and drives use smaller numbers."""


def generator(seed: int, section: str, scene: int = 0) -> np.random.Generator:
    """Return the generator of one section, for scene number `scene` of the round with `seed`."""
    return np.random.default_rng([seed, STREAM + SECTIONS.index(section), scene])


@cache
def ranges() -> Tables:
    """Return the sections of ranges.toml."""
    text = files("simulator.varied").joinpath("ranges.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def drawn_as(kind: type[Kind], section: str, rng: np.random.Generator) -> Kind:
    """Return an object of the dataclass `kind`; its fields are random values of the section
    `section`."""
    values = draw(ranges(), section, rng)
    return kind(**{f.name: values[f.name] for f in fields(kind) if f.name in values})  # type: ignore[arg-type]


def draw(tables: Tables, name: str, rng: np.random.Generator) -> Values:
    """Return random values of the table `name` of `tables`. If the table has the entry `like`, the
    values of the table that `like` names are drawn first; entries of the table itself replace
    them."""
    table = tables[name]
    drawn: Values = draw(tables, table["like"], rng) if "like" in table else {}
    for entry, value in table.items():
        if entry != "like":
            scale = drawn["brightness"] if entry in table.get("scaled", ()) else 1.0
            drawn[entry] = _value(value, drawn, scale, rng)
    return drawn


def _value(value: Any, drawn: Values, scale: float, rng: np.random.Generator) -> Any:
    """Return a random value of one entry, whose `value` is written in the notation of ranges.toml.
    `drawn` contains the values of earlier entries of the table; colours are multiplied by
    `scale`."""
    match value:
        case [float(least), float(most)]:
            return rng.uniform(least, most)
        case [int(least), int(most)]:
            return int(rng.integers(least, most, endpoint=True))
        case {"colour": colour, "spread": spread}:
            return tuple(c * scale * (1.0 + rng.uniform(-spread, spread)) for c in colour)
        case {"colour": colour}:
            return tuple(c * scale for c in colour)
        case {"at_least": least, "gain": gain}:
            return least + gain * drawn["density"]
        case {"one_of": choices, **rest}:
            chances = np.array(rest.get("weights", [1.0] * len(choices)), dtype=np.float64)
            return choices[int(rng.choice(len(choices), p=chances / chances.sum()))]
        case {"sometimes": share, "value": inner, **rest}:
            if rng.uniform() < share:
                return _value(inner, drawn, scale, rng)
            return rest.get("otherwise", 0.0)
        case {"share": share}:
            return bool(rng.uniform() < share)
        case str() if value in drawn:
            return drawn[value]
        case _:
            return value


def rebuilt(kind: Any, value: Any) -> Any:
    """Return the object of type `kind` whose `dataclasses.asdict` is `value`. `value` may have been
    stored as JSON, which turns tuples into lists.

    Raises KeyError, TypeError or ValueError if a field is unknown, a field without a default is
    missing, or a tuple has another length. The types of numbers and texts are not checked.
    """
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        unknown = set(value) - {field.name for field in fields(kind)}
        if unknown:
            raise ValueError(f"unknown value {min(unknown)!r} of a {getattr(kind, '__name__', '')}")
        return kind(**{name: rebuilt(hints[name], part) for name, part in value.items()})  # type: ignore[operator]
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        parts = (kinds[0],) * len(value) if kinds[-1] is Ellipsis else kinds
        return tuple(rebuilt(k, part) for k, part in zip(parts, value, strict=True))
    return value
