"""The kinds of random roads and the ranges of their random values; see kinds.toml.

Lengths in m; ranges are (least, greatest).
"""

import tomllib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, Final

import numpy as np

BLOCK: Final = 20
"""Number of consecutive seeds that form a block; a block starts at a multiple of this number. The
shares of all kinds add up to it. In each block every kind occurs as often as its `share` states."""

Range = tuple[float, float]


@dataclass(frozen=True)
class Kind:
    """The parameters of one kind of random road."""

    name: str
    share: int
    """Number of roads of this kind in each block of `BLOCK` seeds."""
    corners: tuple[int, int]
    """Least and greatest number of corners of a lap."""
    edge_m: Range
    """Mean distance from one corner to the next corner."""
    unevenness: float
    """Amount by which the distance of the corners from the centre varies; 0: a round course."""
    radius_m: Range
    """Radius of the bends, log-uniform. A bend that does not fit between its neighbours gets a
    smaller radius, but not a radius below the range."""
    abrupt: float
    """Share of the bends that begin and end without a spiral."""
    compound: float
    """Share of the sharp corners that consist of two or three arcs with different radii."""
    spiral: Range
    """Length of each spiral as a share of radius times angle."""
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
    """Return all kinds of kinds.toml."""
    text = files(__package__).joinpath("kinds.toml").read_text(encoding="utf-8")
    return tuple(_kind(name, row) for name, row in tomllib.loads(text).items())


def _kind(name: str, row: dict[str, Any]) -> Kind:
    """Make a kind from its table in kinds.toml; lists become tuples."""
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in row.items()}
    return Kind(name=name, **fields)


def least_width_m() -> float:
    """Return the least width (m) of a random road of any kind."""
    return min(kind.width_m[0] for kind in kinds())


def kind_of(seed: int) -> Kind:
    """Return the kind of the road of `seed`."""
    block, place = divmod(seed, BLOCK)
    dealt = [kind for kind in kinds() for _ in range(kind.share)]
    return dealt[int(np.random.default_rng([block, 1]).permutation(len(dealt))[place])]
