"""Scenery themes of the tracks: colours, hills, trees and objects beside the road.

Colours are linear RGB albedos; densities are per 100 m of track.
"""

from dataclasses import dataclass

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Theme:
    """One scenery theme; a scene varies its values at random, by its seed."""

    asphalt: Colour
    verge: Colour
    """Between asphalt and the track's edge."""
    grass: Colour
    dry: Colour
    soil: Colour
    barriers: tuple[str, ...]
    """Which of rail, wall, hedge, fence, stones, tyres line the road, by section."""
    trees: tuple[str, ...]
    tree_density: float
    tree_reach_m: float = 45.0
    clearings: float = 0.3
    """How much the trees thin out here and there, 0 to 0.35."""
    hills_m: float = 8.0
    houses: float = 0.0
    stands: float = 0.0
    signs: float = 0.8
    posts: bool = False
    lamps: bool = False
    poles: bool = False
    """Telegraph poles along one side."""
    blocks: float = 0.0
    """Tall flat-roofed buildings."""
    grassy: float = 0.35
    """Share of the verge that is grown over."""
    sea: bool = False
    """Whether the terrain outside the loop descends to a sea."""
    bridges: tuple[str, ...] = ()
    """Styles (see `bridges.styles`) of the bridges over the road."""
    bridge_every_m: float = 450.0
    worn: float = 0.4
    """How patched and cracked the surface is, 0 to 1."""


_GREEN, _DRY, _SOIL = (0.085, 0.15, 0.032), (0.21, 0.19, 0.075), (0.20, 0.145, 0.09)

THEMES: dict[str, Theme] = {
    "highway": Theme(
        (0.125, 0.125, 0.13),
        (0.16, 0.155, 0.145),
        _GREEN,
        _DRY,
        _SOIL,
        ("rail", "rail", "wall"),
        ("oak", "pine", "bush"),
        9.0,
        60.0,
        hills_m=10.0,
        signs=1.2,
        lamps=True,
        bridges=("overpass", "gantry", "overpass", "footbridge"),
        worn=0.3,
    ),
    "ring-road": Theme(
        (0.115, 0.115, 0.12),
        (0.22, 0.215, 0.205),
        (0.09, 0.14, 0.045),
        (0.19, 0.18, 0.09),
        _SOIL,
        ("wall", "wall", "rail"),
        ("birch", "poplar", "bush"),
        6.0,
        45.0,
        hills_m=4.0,
        signs=1.6,
        lamps=True,
        blocks=1.8,
        grassy=0.1,
        bridges=("gantry", "overpass", "gantry", "railway"),
        bridge_every_m=350.0,
        worn=0.35,
    ),
    "mountain": Theme(
        (0.12, 0.118, 0.118),
        (0.21, 0.20, 0.18),
        (0.10, 0.135, 0.05),
        (0.23, 0.21, 0.13),
        (0.26, 0.25, 0.23),
        ("rail", "stones", "rail"),
        ("pine", "fir", "pine"),
        11.0,
        50.0,
        hills_m=85.0,
        houses=0.15,
        signs=0.7,
        posts=True,
        bridges=("arch", "railway"),
        worn=0.6,
    ),
    "circuit": Theme(
        (0.10, 0.10, 0.105),
        (0.10, 0.17, 0.04),
        (0.08, 0.16, 0.03),
        (0.15, 0.17, 0.05),
        _SOIL,
        ("rail", "tyres", "wall"),
        ("oak", "poplar", "bush"),
        5.0,
        70.0,
        hills_m=6.0,
        stands=0.35,
        signs=1.8,
        bridges=("adverts", "footbridge", "gantry"),
        worn=0.2,
    ),
    "oval": Theme(
        (0.115, 0.112, 0.112),
        (0.145, 0.14, 0.135),
        (0.085, 0.155, 0.035),
        _DRY,
        _SOIL,
        ("wall",),
        ("oak", "poplar"),
        2.5,
        80.0,
        hills_m=2.5,
        stands=0.7,
        signs=1.5,
        lamps=True,
        bridges=("adverts",),
        worn=0.3,
    ),
    "town": Theme(
        (0.13, 0.13, 0.132),
        (0.30, 0.285, 0.27),
        (0.09, 0.14, 0.04),
        _DRY,
        _SOIL,
        ("fence", "hedge", "wall"),
        ("oak", "poplar", "bush"),
        4.0,
        35.0,
        hills_m=3.0,
        houses=5.5,
        signs=2.2,
        lamps=True,
        blocks=1.4,
        grassy=0.0,
        bridges=("railway", "footbridge", "arch"),
        worn=0.8,
    ),
    "forest": Theme(
        (0.115, 0.115, 0.112),
        (0.15, 0.13, 0.085),
        (0.07, 0.115, 0.03),
        (0.16, 0.12, 0.06),
        (0.15, 0.11, 0.07),
        ("fence", "rail"),
        ("fir", "oak", "birch", "fir", "bush"),
        30.0,
        34.0,
        clearings=0.12,
        hills_m=12.0,
        grassy=0.6,
        signs=0.5,
        posts=True,
        bridges=("wooden", "arch"),
        worn=0.6,
    ),
    "coast": Theme(
        (0.15, 0.148, 0.142),
        (0.30, 0.26, 0.19),
        (0.13, 0.16, 0.055),
        (0.32, 0.27, 0.16),
        (0.38, 0.32, 0.22),
        ("rail", "stones", "rail", "wall"),
        ("palm", "bush", "palm"),
        9.0,
        30.0,
        hills_m=12.0,
        sea=True,
        houses=0.8,
        signs=0.8,
        bridges=("arch", "footbridge"),
        worn=0.5,
    ),
    "gravel": Theme(
        (0.24, 0.20, 0.15),
        (0.22, 0.17, 0.11),
        (0.11, 0.14, 0.045),
        (0.27, 0.22, 0.11),
        (0.27, 0.21, 0.14),
        ("fence", "stones"),
        ("bush", "pine", "bush", "birch"),
        9.0,
        50.0,
        hills_m=30.0,
        poles=True,
        houses=0.2,
        signs=0.3,
        bridges=("wooden",),
        worn=1.0,
    ),
    "countryside": Theme(
        (0.13, 0.128, 0.125),
        (0.14, 0.15, 0.06),
        (0.095, 0.17, 0.035),
        (0.27, 0.23, 0.085),
        _SOIL,
        ("fence", "hedge", "stones"),
        ("oak", "poplar", "bush"),
        7.0,
        70.0,
        hills_m=14.0,
        houses=0.5,
        signs=0.6,
        posts=True,
        poles=True,
        grassy=0.7,
        bridges=("railway", "arch", "overpass"),
        worn=0.7,
    ),
}

PLAIN = "countryside"


def find_theme(name: str) -> Theme:
    """The theme called `name`; an unknown name gets the countryside."""
    return THEMES.get(name, THEMES[PLAIN])
