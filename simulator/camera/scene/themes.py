"""Scenery themes of the tracks: colours, hills, trees, objects beside the road; see themes.toml.

Colours are linear RGB albedos; densities are per 100 m of track.
"""

import tomllib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Theme:
    """One scenery theme; each scene varies its values at random, by its seed."""

    asphalt: Colour
    verge: Colour
    """Colour of the strip between asphalt and the track's edge."""
    grass: Colour
    dry: Colour
    soil: Colour
    barriers: tuple[str, ...]
    """Kinds of barriers (rail, wall, hedge, fence, stones, tyres) along the road, by section."""
    trees: tuple[str, ...]
    tree_density: float
    tree_reach_m: float = 45.0
    clearings: float = 0.3
    """How much the trees thin out in places, 0 to 0.35."""
    hills_m: float = 8.0
    houses: float = 0.0
    stands: float = 0.0
    signs: float = 0.8
    posts: bool = False
    lamps: bool = False
    poles: bool = False
    """Telegraph poles along one side."""
    blocks: float = 0.0
    """Density of tall flat-roofed buildings."""
    grassy: float = 0.35
    """Share of the verge that is grown over."""
    sea: bool = False
    """Whether the terrain outside the loop descends to a sea."""
    bridges: tuple[str, ...] = ()
    """Styles (see `bridges.styles`) of the bridges over the road."""
    bridge_every_m: float = 450.0
    worn: float = 0.4
    """How patched and cracked the surface is, 0 to 1."""


@cache
def themes() -> dict[str, Theme]:
    """All themes by name, from themes.toml."""
    text = files("simulator.camera.scene").joinpath("themes.toml").read_text(encoding="utf-8")
    return {name: _theme(values) for name, values in tomllib.loads(text).items()}


def _theme(values: dict[str, Any]) -> Theme:
    """A theme from its table, whose lists become tuples."""
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return Theme(**fields)


PLAIN = "countryside"


def find_theme(name: str) -> Theme:
    """The theme called `name`; an unknown name gets the countryside."""
    return themes().get(name, themes()[PLAIN])
