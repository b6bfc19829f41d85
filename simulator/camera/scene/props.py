"""Builds the props beside the road: houses, grandstands, signs, marker posts, poles, lamps.

Each prop is a template in its own frame: x along the road, y away from it, z up, metres. Templates
are placed many times in the world frame (metres). Triangles are vertices (n, 12), three a triangle:
position, normal, colour, u, v, material number (see `solids`).
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.bridges.bridges import KEEP_FREE_M, Bridge, free_of
from simulator.camera.bridges.styles import CONCRETE
from simulator.camera.core.mesh import Chunks, Surface
from simulator.camera.scene.road_mesh import Ground, RoadMesh
from simulator.camera.scene.solids import (
    BOARD,
    CROWD,
    FACADE,
    LIT,
    MATERIALS,
    PLAIN,
    STRIPED,
    TILES,
    Point,
    box,
    face,
)
from simulator.camera.scene.themes import Theme
from simulator.camera.vegetation.scenery import DRY_M

LAYOUT = ("3f 3f 3f 2f", "at", "facing", "colour", "face")
"""Layout of a vertex: the layout of `solids` without the material."""
CHUNK_M, REACH_M = 50.0, 350.0
SMALL_M2, SMALL_REACH_M = 14.0, 130.0
"""Props with a smaller area than SMALL_M2 (posts, lamps, signs) are drawn only up to SMALL_REACH_M,
because they would flicker farther away."""
BUILDING_M = 3.9
"""A prop that extends farther than this (m) from its origin counts as a building."""
BUILDING_CLEAR_M = 1.0
"""Least distance (m) between a building and the wall line."""
OUTLINE_STEP_M = 2.0
POST_STEP_M, LAMP_STEP_M, POLE_STEP_M = 50.0, 42.0, 40.0
_WALLS: tuple[Point, ...] = (
    (0.62, 0.58, 0.50), (0.66, 0.64, 0.60), (0.42, 0.22, 0.15), (0.58, 0.47, 0.30),
    (0.45, 0.46, 0.48), (0.52, 0.34, 0.25),
)  # fmt: skip
_ROOFS: tuple[Point, ...] = ((0.26, 0.10, 0.06), (0.13, 0.12, 0.125), (0.20, 0.13, 0.09))
_BOARDS: tuple[Point, ...] = (
    (0.02, 0.09, 0.36), (0.03, 0.22, 0.09), (0.62, 0.46, 0.03), (0.60, 0.60, 0.58),
    (0.48, 0.03, 0.03), (0.50, 0.18, 0.02),
)  # fmt: skip


def house(rng: np.random.Generator) -> FloatArray:
    """Return the triangles (n, 12) of a house of one to three floors under a gabled roof."""
    wide, deep = rng.uniform(8.0, 15.0), rng.uniform(7.0, 10.0)
    high = 2.9 * rng.integers(1, 4) + 0.4
    wall, roof = _WALLS[rng.integers(len(_WALLS))], _ROOFS[rng.integers(len(_ROOFS))]
    x, y, top = wide / 2 + 0.4, deep / 2 + 0.4, high + deep * rng.uniform(0.28, 0.45)
    ridge = [np.array([-x, 0.0, top]), np.array([x, 0.0, top])]
    eaves = high - 0.15
    parts = [box((wide, deep, high + 1.0), (0.0, 0.0, -1.0), wall, FACADE)]
    for side in (-1.0, 1.0):
        low = [np.array([side * x, side * y, eaves]), np.array([-side * x, side * y, eaves])]
        high_edge = [ridge[0], ridge[1]] if side > 0 else [ridge[1], ridge[0]]
        slope = [(0.0, 0.0), (wide, 0.0), (wide, 5.0), (0.0, 5.0)]
        parts.append(face([*low, *high_edge], slope, roof, TILES))
        gable = [
            np.array([side * wide / 2, -side * deep / 2, high]),
            np.array([side * wide / 2, side * deep / 2, high]),
            np.array([side * wide / 2, 0.0, top - 0.1]),
            np.array([side * wide / 2, 0.0, top - 0.1]),
        ]
        parts.append(face(gable, [(0.0, 0.0)] * 4, wall, PLAIN))
    return np.concatenate(parts)


def grandstand(rng: np.random.Generator) -> FloatArray:
    """Return the triangles (n, 12) of a grandstand: rising tiers full of people under a roof."""
    wide = float(rng.uniform(25.0, 45.0))
    colour = _BOARDS[rng.integers(len(_BOARDS))]
    parts = [box((wide, 1.0, 2.6), (0.0, -5.0, -1.0), colour)]
    low, back = np.array([0.0, -4.5, 1.6]), np.array([0.0, 5.0, 7.0])
    right = np.array([wide / 2, 0.0, 0.0])
    tiers = [low - right, low + right, back + right, back - right]
    parts.append(face(tiers, [(0, 0), (wide, 0), (wide, 11.0), (0, 11.0)], (0.3, 0.3, 0.3), CROWD))
    parts.append(box((wide, 0.4, 10.0), (0.0, 5.2, -1.0), (0.4, 0.4, 0.41)))
    parts.append(box((wide, 9.0, 0.35), (0.0, 1.0, 10.0), colour))
    return np.concatenate(parts)


def sign(rng: np.random.Generator) -> FloatArray:
    """Return the triangles (n, 12) of a board on two legs that faces traffic driving along +x."""
    wide, high = float(rng.uniform(0.8, 3.4)), float(rng.uniform(0.7, 1.5))
    foot = float(rng.uniform(1.3, 2.0))
    board = box((0.06, wide, high), (0.0, 0.0, foot), _BOARDS[rng.integers(len(_BOARDS))], BOARD)
    # The shader places the lettering in shares of the board's size.
    board[:, 9] /= wide
    board[:, 10] /= high
    legs = [
        box((0.08, 0.08, foot + 1.0), (0.05, y * wide * 0.35, -0.9), (0.3, 0.3, 0.3))
        for y in (-1, 1)
    ]
    return np.concatenate([board, *legs])


def marker_post() -> FloatArray:
    """Return the triangles (n, 12) of a white marker post with a dark band."""
    return box((0.09, 0.12, 1.3), (0.0, 0.0, -0.3), (0.72, 0.72, 0.70), STRIPED)


def apartment_block(rng: np.random.Generator) -> FloatArray:
    """Return the triangles (n, 12) of an apartment block of four to nine floors under a flat
    roof."""
    wide, deep = float(rng.uniform(12.0, 26.0)), float(rng.uniform(9.0, 13.0))
    high = float(2.9 * rng.integers(4, 10) + 0.4)
    wall = _WALLS[rng.integers(len(_WALLS))]
    return np.concatenate(
        [
            box((wide, deep, high + 1.0), (0.0, 0.0, -1.0), wall, FACADE),
            box((wide + 0.3, deep + 0.3, 0.5), (0.0, 0.0, high), (0.30, 0.30, 0.30)),
            box((3.0, 3.0, 2.2), (wide * 0.2, 0.0, high + 0.5), (0.35, 0.35, 0.34)),
        ]
    )


def pole() -> FloatArray:
    """Return the triangles (n, 12) of a wooden telegraph pole with two cross-arms."""
    wood, mast = (0.13, 0.09, 0.06), (0.22, 0.22, 9.0)
    arms = [box((0.12, 2.0, 0.12), (0.0, 0.0, z), wood) for z in (6.9, 7.6)]
    return np.concatenate([box(mast, (0.0, 0.0, -0.9), wood), *arms])


def lamp(head: float = PLAIN) -> FloatArray:
    """Return the triangles (n, 12) of a lamp on a tall mast. The arm points over the road (-y).
    `head` is the material number of the lamp's head."""
    grey = (0.24, 0.25, 0.25)
    return np.concatenate(
        [
            box((0.16, 0.16, 9.0), (0.0, 0.0, -0.8), grey),
            box((0.1, 2.2, 0.1), (0.0, -1.0, 8.1), grey),
            box((0.25, 0.8, 0.14), (0.0, -2.2, 8.0), (0.45, 0.45, 0.43), head, floor=head == LIT),
        ]
    )


class _Placer:
    """Selects the positions of props beside the road and collects their triangles."""

    def __init__(self, ground: Ground, bridges: Sequence[Bridge]) -> None:
        self.ground, self.bridges = ground, bridges
        self.candidates: list[tuple[FloatArray, float, float, float]] = []
        self.s: list[float] = []
        self.parts: list[FloatArray] = []

    def add(self, template: FloatArray, s: float, offset: float, clear_m: float) -> None:
        """Add `template` (n, 12) at (`s`, `offset`) m to the candidates of `place`. If this
        position is nearer than `clear_m` (m) to a wall line, `place` skips the candidate."""
        self.candidates.append((template, s, offset, clear_m))

    def place(self) -> None:
        """Place the candidates in order. Skip candidates within `clear_m` of a wall line, near a
        bridge, below the sea level or, for buildings, overlapping the road or another building."""
        if not self.candidates:
            return
        templates, *numbers = zip(*self.candidates, strict=True)
        s, offset, clear_m = (np.array(column) for column in numbers)
        free, x, y = self.ground.place_beside(s, offset, clear_m)
        free &= free_of(self.bridges, x, y, clear_m + KEEP_FREE_M)
        z = self.ground.height(s, offset, x, y)
        free &= z >= self.ground.terrain.sea + DRY_M
        # On the right side the template is rotated by 180 degrees, so that its -y faces the road.
        turn = self.ground.road.track.at(s).heading + np.where(offset > 0, 0.0, np.pi)
        cos, sin = np.cos(turn), np.sin(turn)
        taken: list[tuple[float, float, float]] = []
        for k in np.flatnonzero(free).tolist():
            template = templates[k]
            place = np.array([x[k], y[k]])
            rotate = np.array([[cos[k], sin[k]], [-sin[k], cos[k]]])
            reach = float(np.abs(template[:, :2]).max())
            if reach > BUILDING_M:
                if any(
                    np.hypot(x[k] - u, y[k] - v) < 0.9 * (reach + other) for u, v, other in taken
                ):
                    continue
                # In a bend, or beside another part of the track, a building's ends can be nearer
                # to a wall line than its middle.
                if not self.ground.is_clear(_outline(template) @ rotate + place, BUILDING_CLEAR_M):
                    continue
                taken.append((x[k], y[k], reach))
            placed = template.copy()
            placed[:, :2] = template[:, :2] @ rotate + place
            placed[:, 2] += z[k]
            placed[:, 3:5] = template[:, 3:5] @ rotate
            self.add_placed(s[k], placed)

    def add_placed(self, s: float, triangles: FloatArray) -> None:
        """Add triangles (n, 12) in the world frame, near `s` (m)."""
        self.s.append(s)
        self.parts.append(triangles)


def _outline(template: FloatArray) -> FloatArray:
    """Return points (n, 2) on `template`'s bounding rectangle, at most OUTLINE_STEP_M apart."""
    low, high = template[:, :2].min(axis=0), template[:, :2].max(axis=0)
    x, y = (
        np.linspace(a, b, math.ceil((b - a) / OUTLINE_STEP_M) + 1)
        for a, b in zip(low, high, strict=True)
    )
    along = [np.stack([x, np.full_like(x, edge)], axis=1) for edge in (low[1], high[1])]
    across = [np.stack([np.full_like(y, edge), y], axis=1) for edge in (low[0], high[0])]
    return np.concatenate([*along, *across])


def build(
    ground: Ground,
    theme: Theme,
    bridges: Sequence[Bridge],
    rng: np.random.Generator,
    lit_every_m: float = 0.0,
) -> dict[str, Surface]:
    """Build all props and bridges of a scene; returns one surface for each material, by the
    material's name. Lit lamps are placed on the right side, one every `lit_every_m` (m), none if it
    is 0."""
    placer = _Placer(ground, bridges)
    _add_soffits(placer, ground.mesh)
    for bridge in bridges:
        placer.add_placed(bridge.s, bridge.triangles)
    length, wall = ground.road.track.length_m, ground.road.wall_offset
    for make, density, near, far, clear in (
        (house, theme.houses, 9.0, 24.0, 7.5),
        (apartment_block, theme.blocks, 13.0, 34.0, 11.0),
        (grandstand, theme.stands, 9.0, 14.0, 6.5),
        (sign, theme.signs, 0.9, 2.2, 0.4),
    ):
        for s in rng.uniform(0.0, length, rng.poisson(density * length / 100.0)):
            side = rng.choice([-1.0, 1.0])
            offset = side * (wall + rng.uniform(near, far))
            placer.add(make(rng), float(s), float(offset), clear)
    if theme.posts:
        for s in np.arange(0.0, length, POST_STEP_M):
            for side in (-1.0, 1.0):
                placer.add(marker_post(), float(s), side * (wall + 0.35), 0.1)
    if theme.poles:
        side = rng.choice([-1.0, 1.0])
        for s in np.arange(0.0, length, POLE_STEP_M):
            placer.add(pole(), float(s), side * (wall + 3.0), 1.0)
    if theme.lamps:
        side = rng.choice([-1.0, 1.0])
        for s in np.arange(0.0, length, LAMP_STEP_M):
            placer.add(lamp(), float(s), side * (wall + 1.0), 0.6)
    for s in np.arange(0.0, length, lit_every_m) if lit_every_m > 0.0 else ():
        placer.add(lamp(LIT), float(s), -(wall + 1.0), 0.6)
    placer.place()
    return _gathered(placer)


def _add_soffits(placer: _Placer, mesh: RoadMesh) -> None:
    """Add the undersides of the bridges on which the road crosses itself."""
    edges = mesh.deck_edges()
    for row in np.flatnonzero(mesh.bridge[:-1] | mesh.bridge[1:]).tolist():
        (left, right), (far_left, far_right) = edges[row], edges[row + 1]
        length, width = mesh.s[row + 1] - mesh.s[row], mesh.y[row, 0] - mesh.y[row, -1]
        corners = [left, far_left, far_right, right]
        uv = [(0.0, 0.0), (length, 0.0), (length, width), (0.0, width)]
        placer.add_placed(mesh.s[row], face(corners, uv, CONCRETE[0], PLAIN))


def _gathered(placer: _Placer) -> dict[str, Surface]:
    """Group the triangles of all props by the name of their material."""
    small = [_area(part) < SMALL_M2 for part in placer.parts]
    surfaces = {}
    for number, material in enumerate(MATERIALS):
        parts = [part[part[:, 11] == number, :11] for part in placer.parts]
        used = [k for k, part in enumerate(parts) if len(part)]
        if used:
            surfaces[material] = _surface(
                [parts[k] for k in used],
                np.array([placer.s[k] for k in used]),
                np.array([small[k] for k in used]),
            )
    return surfaces


def _surface(parts: list[FloatArray], s: FloatArray, small: NDArray[np.bool_]) -> Surface:
    """Build the surface of one material from the triangles `parts` of its props, in order of their
    positions `s` (m), with a chunk every CHUNK_M. In each chunk the triangles of the props marked
    in `small` come last, because the second level of detail leaves them out."""
    cell = (s / CHUNK_M).astype(np.int64)
    order = np.lexsort((s, small, cell))
    sizes = np.array([len(part) for part in parts])[order]
    vertices = np.concatenate([parts[k] for k in order])
    starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
    first = (np.cumsum(sizes) - sizes)[starts]
    count = np.stack(
        [np.add.reduceat(sizes, starts), np.add.reduceat(np.where(small[order], 0, sizes), starts)]
    )
    low = np.minimum.reduceat(vertices[:, :3], first, axis=0)
    high = np.maximum.reduceat(vertices[:, :3], first, axis=0)
    chunks = Chunks(
        low,
        high,
        np.stack([first, first]).astype(np.int64),
        count.astype(np.int64),
        (SMALL_REACH_M, REACH_M),
    )
    indices = np.arange(len(vertices), dtype=np.uint32)
    return Surface(vertices.astype(np.float32), indices, chunks)


def _area(triangles: FloatArray) -> float:
    """Return the area (m2) of triangles (3 T, ...); a vertex begins with its position."""
    a, b, c = (triangles[k::3, :3] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)
