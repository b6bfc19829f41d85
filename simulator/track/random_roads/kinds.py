"""The kinds of random roads and the ranges that they are drawn from; see kinds.toml.

Lengths in m; ranges are (least, most).
"""

import tomllib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, Final

import numpy as np

BLOCK: Final = 20
"""Sum of the shares. `BLOCK` seeds in a row, from a multiple of it, have each kind in its share."""

Range = tuple[float, float]


@dataclass(frozen=True)
class Kind:
    """One kind of road."""

    name: str
    share: int
    """Roads of this kind among `BLOCK` seeds."""
    corners: tuple[int, int]
    """Number of corners of a lap."""
    edge_m: Range
    """Mean distance from corner to corner."""
    unevenness: float
    """How much the corners' distance from the middle varies; 0: a round course."""
    radius_m: Range
    """Radius of the bends, log-uniform. A bend that does not fit between its neighbours becomes
    tighter, down to the least radius."""
    abrupt: float
    """Share of the bends that begin and end without a spiral."""
    compound: float
    """Share of the sharp corners that are two or three arcs of different radii."""
    spiral: Range
    """Length of each spiral, as a share of radius times angle."""
    banking_deg: Range
    """Banking of bends with spirals."""
    grade_percent: Range
    """Steepest grade of a lap."""
    hill_m: Range
    """Wavelength of the hills."""
    vertical_curve_m: Range
    width_m: Range
    looks: tuple[str, ...]
    gravel: float
    """Share of the roads with a gravel surface."""
    kerbs: float
    """Share of the roads with kerbs."""
    wear: Range


@cache
def kinds() -> tuple[Kind, ...]:
    """All kinds, from kinds.toml."""
    text = files(__package__).joinpath("kinds.toml").read_text(encoding="utf-8")
    return tuple(_kind(name, row) for name, row in tomllib.loads(text).items())


def _kind(name: str, row: dict[str, Any]) -> Kind:
    """A kind from its table, whose lists become tuples."""
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in row.items()}
    return Kind(name=name, **fields)


def kind_of(seed: int) -> Kind:
    """The kind of the road of `seed`."""
    block, place = divmod(seed, BLOCK)
    dealt = [kind for kind in kinds() for _ in range(kind.share)]
    return dealt[int(np.random.default_rng([block, 1]).permutation(len(dealt))[place])]
