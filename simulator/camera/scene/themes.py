"""Scenery themes of the tracks: colours, hills, trees, objects beside the road. themes.toml
contains the values.

Colours are linear RGB albedos; densities are numbers per 100 m of track.
"""

import tomllib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Theme:
    """One scenery theme. Each scene varies the theme's values at random, determined by the scene's
    seed."""

    asphalt: Colour
    verge: Colour
    """Colour of the strip between asphalt and edge of the track."""
    grass: Colour
    dry: Colour
    soil: Colour
    barriers: tuple[str, ...]
    """Kinds of barriers along the road (see `barriers.KINDS`); each section has one kind."""
    trees: tuple[str, ...]
    tree_density: float
    tree_reach_m: float = 45.0
    clearings: float = 0.3
    """Amount, 0 to 0.35, by which the density of trees decreases in places."""
    hills_m: float = 8.0
    houses: float = 0.0
    stands: float = 0.0
    signs: float = 0.8
    posts: bool = False
    lamps: bool = False
    poles: bool = False
    """Whether telegraph poles stand along one side of the road."""
    blocks: float = 0.0
    """Density of apartment blocks with flat roofs."""
    grassy: float = 0.35
    """Share of the verge that grass covers."""
    sea: bool = False
    """Whether the terrain outside the loop descends to a sea."""
    bridges: tuple[str, ...] = ()
    """Styles (see `bridges.styles`) of the bridges over the road."""
    bridge_every_m: float = 450.0
    worn: float = 0.4
    """Amount of patches and cracks on the road surface, 0 to 1."""


@cache
def themes() -> dict[str, Theme]:
    """Return all themes of themes.toml by name."""
    text = files("simulator.camera.scene").joinpath("themes.toml").read_text(encoding="utf-8")
    return {name: _theme(values) for name, values in tomllib.loads(text).items()}


def _theme(values: dict[str, Any]) -> Theme:
    """Make a theme from its table in themes.toml; lists become tuples."""
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return Theme(**fields)


PLAIN = "countryside"


def find_theme(name: str) -> Theme:
    """Return the theme called `name`, or the theme "countryside" if the name is unknown."""
    return themes().get(name, themes()[PLAIN])
