"""Selects the scenery of an imported TORCS track from its category, surface, name and height.

TORCS stores scenery in 3D models, which are not read. If the track's name contains no word of the
list NAMED, the look is random, from looks for tracks with kerbs or from looks for tracks without.
"""

import hashlib
from typing import Final

from simulator.track.geometry import Surface
from simulator.track.pieces import Placed
from simulator.track.torcs.torcs_xml import Section

MOUNTAIN_HEIGHT_M: Final = 55.0
"""Least difference in height with which a track gets mountain scenery."""
NAMED: Final = (
    ("mountain", ("alpine", "mountain", "pass", "hill")),
    ("town", ("street", "city", "town")),
    ("oval", ("speedway", "oval", "michigan")),
    ("forest", ("forest", "wood", "skog", "aalborg")),
    ("coast", ("coast", "beach", "corkscrew")),
    ("highway", ("eroad", "highway", "motorway")),
    ("countryside", ("ole-road", "spring")),
    ("circuit", ("forza", "wheel", "brondehach")),
)
"""Looks, each with the words in a track's name that select it; the first match is used."""
WITH_KERBS: Final = ("circuit", "forest", "circuit", "countryside")
WITHOUT_KERBS: Final = ("countryside", "forest", "ring-road", "highway")


def surface_and_look(
    name: str, root: Section, main: Section, placed: Placed
) -> tuple[Surface, str]:
    """Return the surface and the look (scenery theme) of the track called `name`. `root` is the
    root section of its file, `main` the section "Main Track". `placed` gives the heights of the
    track."""
    surface = _surface(root, main)
    if surface == "gravel":
        return surface, "gravel"
    if _category(root) == "oval":
        return surface, "oval"
    for look, words in NAMED:
        if any(word in name.lower() for word in words):
            return surface, look
    middle = (placed.z_left0 + placed.z_right0) / 2.0
    if float(middle.max() - middle.min()) > MOUNTAIN_HEIGHT_M:
        return surface, "mountain"
    looks = WITH_KERBS if has_kerbs(main) else WITHOUT_KERBS
    return surface, looks[hashlib.sha256(name.encode()).digest()[4] % len(looks)]


def has_kerbs(main: Section) -> bool:
    """Return whether any segment in the section `main` ("Main Track") has a kerb beside it."""
    return any(
        "curb" in (attribute.get("val") or "").lower()
        for attribute in main.element.iter("attstr")
        if attribute.get("name") in ("surface", "style")
    )


def _category(root: Section) -> str:
    header = root.section("Header")
    return (header.text("category") if header else None) or "road"


def _surface(root: Section, main: Section) -> Surface:
    name = (main.text("surface") or "").lower()
    if _category(root) == "dirt" or "dirt" in name or "gravel" in name or "sand" in name:
        return "gravel"
    return "concrete" if "conc" in name else "asphalt"
