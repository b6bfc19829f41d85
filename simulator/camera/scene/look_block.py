"""Fills the uniform block `Look` of look.glsl with the values of a varied road's look."""

import numpy as np
from numpy.typing import NDArray

from simulator.camera.scene.roadside import seen_road
from simulator.camera.scene.themes import Colour
from simulator.camera.scene.varied_light import lamp_colour
from simulator.track.road import Road
from simulator.varied.look import Lighting, Paint, RoadLook, Surface

MARKINGS, LINES = 4, 2
"""Largest number of markings of a road, and of lines of a marking, in the block."""
LINE_COLOURS: dict[str, Colour] = {"white": (0.78, 0.78, 0.75), "yellow": (0.75, 0.50, 0.06)}
ARROWS = {"ahead": 0.0, "left": 1.0, "right": -1.0}
LAMP_SIDE = -1.0
"""Side of the street lamps of a varied road; -1 is right."""
Row = tuple[float, ...]


def look_block(road: Road, look: RoadLook) -> NDArray[np.float32]:
    """Return the block (rows, 4) of `look` on `road`, in the order of look.glsl."""
    rows = [
        *_side_rows(road),
        *_line_rows(road, look.paint),
        *_paint_rows(look.paint),
        *_surface_rows(look.surface),
        (look.roadside.height, look.surface.phase, 0.0, 0.0),
        *_lamp_rows(seen_road(road, look), look.light),
    ]
    return np.array(rows, dtype=np.float32)


def _side_rows(road: Road) -> list[Row]:
    left, right = road.asphalt
    return [(left, -right, 0.0, 0.0)]


def _line_rows(road: Road, paint: Paint) -> list[Row]:
    """Return the rows with position and pattern of the lines of all markings, then the rows with
    the colours of these lines. `paint` is the paint of the scene."""
    assert road.carriageway is not None
    places: list[Row] = [(0.0, -1.0, 0.0, 1.0)] * (MARKINGS * LINES)
    colours: list[Row] = [(0.0, 0.0, 0.0, 0.0)] * (MARKINGS * LINES)
    for number, marking in enumerate(road.carriageway.markings):
        for k, line in enumerate(marking.lines):
            at = LINES * number + k
            middle = float(road.markings_y[number]) + line.offset_m
            solid = 0.0 if line.dots_m and not line.gap_m else 1.0
            period = line.dash_m + line.gap_m
            places[at] = (middle, line.width_m / 2, line.dash_m if period else solid, period or 1.0)
            colours[at] = (*_toned(line.colour, paint), line.dots_m)
    return [*places, *colours]


def _toned(colour: str, paint: Paint) -> Row:
    return tuple(c * paint.tone for c in LINE_COLOURS[colour])


def _paint_rows(paint: Paint) -> list[Row]:
    """Return the rows with wear, gaps, colour, arrows and crosswalks of the paint."""
    return [
        (paint.wear, paint.missing, paint.phase, 0.0),
        (paint.gap_m, paint.gap_every_m, float(paint.gap_marking), 0.0),
        (*_toned("white", paint), 0.0),
        (
            paint.arrow_every_m,
            ARROWS[paint.arrow_kind],
            paint.crosswalk_every_m,
            0.0,
        ),
    ]


def _surface_rows(surface: Surface) -> list[Row]:
    """Return the rows with the properties of the road's surface."""
    ratio = surface.other_tone / surface.tone if surface.tone else 0.0
    return [
        (ratio, surface.section_m, 0.0, 0.0),
        (surface.concrete, surface.joint_m, surface.halves, surface.seam_m),
        (surface.tar, surface.patches, surface.patch_tone, surface.phase),
        (surface.tracks, surface.grain, surface.puddles, surface.ragged_m),
        (surface.gravel_m, surface.kerb_m, 0.0, 0.0),
    ]


def surface_features(surface: Surface) -> tuple[str, ...]:
    """Return the names of the features of surface.glsl that `surface` needs. The shader is compiled
    without the remaining features, because they would cost time."""
    wanted = {
        "slabs": surface.other_tone > 0.0 or surface.concrete > 0.0,
        "repairs": surface.tar > 0.0 or surface.patches > 0.0,
        "puddles": surface.puddles > 0.0,
    }
    return tuple(name for name, used in wanted.items() if used)


def _lamp_rows(road: Road, light: Lighting) -> list[Row]:
    every = light.lamp_every_m if light.night else 0.0
    return [(every, LAMP_SIDE * (road.wall_offset - 1.2), 0.0, 0.0), (*lamp_colour(light), 0.0)]
