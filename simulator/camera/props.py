"""Things that stand beside the road: houses, stands, signs, marker posts, lamps.

Each is a template in its own frame (x along the road, y away from it, z up, metres), put down many
times. World frame, metres.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from simulator.camera.look import Look
from simulator.camera.mesh import Chunks, Surface
from simulator.camera.ribbon import Ribbon
from simulator.camera.scenery import ground_height, place_beside
from simulator.camera.terrain import CentreLine, Terrain
from simulator.track.road import Road

FloatArray = NDArray[np.float64]
Point = tuple[float, float, float]

PLAIN, FACADE, CROWD, BOARD, STRIPED, TILES = (float(k) for k in range(6))
"""Materials, as prop.frag.glsl numbers them."""
CHUNK_M = 50.0
POST_STEP_M, LAMP_STEP_M = 50.0, 42.0
_WALLS: tuple[Point, ...] = (
    (0.62, 0.58, 0.50), (0.66, 0.64, 0.60), (0.42, 0.22, 0.15), (0.58, 0.47, 0.30),
    (0.45, 0.46, 0.48), (0.52, 0.34, 0.25),
)  # fmt: skip
_ROOFS: tuple[Point, ...] = ((0.26, 0.10, 0.06), (0.13, 0.12, 0.125), (0.20, 0.13, 0.09))
_BOARDS: tuple[Point, ...] = (
    (0.02, 0.09, 0.36), (0.03, 0.22, 0.09), (0.62, 0.46, 0.03), (0.60, 0.60, 0.58),
    (0.48, 0.03, 0.03), (0.50, 0.18, 0.02),
)  # fmt: skip


def box(size: Point, at: Point, colour: Point, material: float = PLAIN) -> FloatArray:
    """A box without a floor, (30, 12): place, normal, colour, (u, v) in metres, material."""
    half_x, half_y, height = size[0] / 2, size[1] / 2, size[2]
    faces = []
    for nx, ny, reach, half in ((1, 0, half_x, half_y), (-1, 0, half_x, half_y),
                                (0, 1, half_y, half_x), (0, -1, half_y, half_x)):  # fmt: skip
        along = np.array([-ny, nx, 0.0]) * half
        middle = np.array([nx, ny, 0.0]) * reach
        up = np.array([0.0, 0.0, height])
        corners = [middle - along, middle + along, middle + along + up, middle - along + up]
        uv = [(0.0, 0.0), (2 * half, 0.0), (2 * half, height), (0.0, height)]
        faces.append(_face(corners, uv, colour, material))
    top = [
        np.array([x * half_x, y * half_y, height]) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    faces.append(
        _face(top, [(0, 0), (size[0], 0), (size[0], size[1]), (0, size[1])], colour, PLAIN)
    )
    whole = np.concatenate(faces)
    whole[:, :3] += np.array(at)
    return whole


def _face(
    corners: Sequence[FloatArray], uv: Sequence[tuple[float, float]], colour: Point, material: float
) -> FloatArray:
    rows = np.empty((6, 12))
    order = [0, 1, 2, 0, 2, 3]
    rows[:, :3] = np.array(corners)[order]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    rows[:, 3:6] = normal / max(float(np.linalg.norm(normal)), 1e-9)
    rows[:, 6:9] = colour
    rows[:, 9:11] = np.array(uv)[order]
    rows[:, 11] = material
    return rows


def house(rng: np.random.Generator) -> FloatArray:
    """A house of one to three floors under a gabled roof."""
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
        parts.append(_face([*low, *high_edge], slope, roof, TILES))
        gable = [
            np.array([side * wide / 2, -side * deep / 2, high]),
            np.array([side * wide / 2, side * deep / 2, high]),
            np.array([side * wide / 2, 0.0, top - 0.1]),
            np.array([side * wide / 2, 0.0, top - 0.1]),
        ]
        parts.append(_face(gable, [(0.0, 0.0)] * 4, wall, PLAIN))
    return np.concatenate(parts)


def stand(rng: np.random.Generator) -> FloatArray:
    """A grandstand: rising tiers full of people under a roof."""
    wide = float(rng.uniform(25.0, 45.0))
    colour = _BOARDS[rng.integers(len(_BOARDS))]
    parts = [box((wide, 1.0, 2.6), (0.0, -5.0, -1.0), colour)]
    low, back = np.array([0.0, -4.5, 1.6]), np.array([0.0, 5.0, 7.0])
    right = np.array([wide / 2, 0.0, 0.0])
    tiers = [low - right, low + right, back + right, back - right]
    parts.append(_face(tiers, [(0, 0), (wide, 0), (wide, 11.0), (0, 11.0)], (0.3, 0.3, 0.3), CROWD))
    parts.append(box((wide, 0.4, 10.0), (0.0, 5.2, -1.0), (0.4, 0.4, 0.41)))
    parts.append(box((wide, 9.0, 0.35), (0.0, 1.0, 10.0), colour))
    return np.concatenate(parts)


def sign(rng: np.random.Generator) -> FloatArray:
    """A board on two legs, facing traffic that drives along +x."""
    wide, high = float(rng.uniform(0.8, 3.4)), float(rng.uniform(0.7, 1.5))
    foot = float(rng.uniform(1.3, 2.0))
    board = box((0.06, wide, high), (0.0, 0.0, foot), _BOARDS[rng.integers(len(_BOARDS))], BOARD)
    # Boards are lettered in shares of their size.
    board[:, 9] /= wide
    board[:, 10] /= high
    legs = [
        box((0.08, 0.08, foot + 1.0), (0.05, y * wide * 0.35, -0.9), (0.3, 0.3, 0.3))
        for y in (-1, 1)
    ]
    return np.concatenate([board, *legs])


def marker_post() -> FloatArray:
    """A white marker post with a dark band."""
    return box((0.09, 0.12, 1.3), (0.0, 0.0, -0.3), (0.72, 0.72, 0.70), STRIPED)


def lamp() -> FloatArray:
    """A lamp on a tall mast, its arm over the road (-y)."""
    grey = (0.24, 0.25, 0.25)
    return np.concatenate(
        [
            box((0.16, 0.16, 9.0), (0.0, 0.0, -0.8), grey),
            box((0.1, 2.2, 0.1), (0.0, -1.0, 8.1), grey),
            box((0.25, 0.8, 0.14), (0.0, -2.2, 8.0), (0.45, 0.45, 0.43)),
        ]
    )


class _Site:
    """Puts templates down beside the road and gathers their triangles."""

    def __init__(self, road: Road, line: CentreLine, ribbon: Ribbon, terrain: Terrain) -> None:
        self.road, self.line, self.ribbon, self.terrain = road, line, ribbon, terrain
        self.s: list[float] = []
        self.parts: list[FloatArray] = []

    def put(self, template: FloatArray, s: float, offset: float, clear_m: float) -> None:
        """Stand `template` at (s, offset), unless it comes within `clear_m` of a wall line."""
        free, x, y = place_beside(self.road, self.line, np.array([s]), np.array([offset]), clear_m)
        if not free[0]:
            return
        z = ground_height(self.ribbon, self.terrain, np.array([s]), np.array([offset]), x, y)[0]
        heading = float(self.road.track.at(s).heading)
        # On the right side the template is turned round, so that its -y still faces the road; its
        # x axis then points against the traffic.
        turn = heading if offset > 0 else heading + np.pi
        cos, sin = np.cos(turn), np.sin(turn)
        placed = template.copy()
        rotate = np.array([[cos, sin], [-sin, cos]])
        placed[:, :2] = template[:, :2] @ rotate + np.array([x[0], y[0]])
        placed[:, 2] += z
        placed[:, 3:5] = template[:, 3:5] @ rotate
        self.s.append(s)
        self.parts.append(placed)


def build(
    road: Road,
    line: CentreLine,
    ribbon: Ribbon,
    terrain: Terrain,
    look: Look,
    rng: np.random.Generator,
) -> Surface:
    """All props of a scene; a vertex is place, normal, colour, (u, v), material."""
    site = _Site(road, line, ribbon, terrain)
    length, wall = road.track.length_m, road.wall_offset
    for make, density, near, far, clear in (
        (house, look.houses, 9.0, 24.0, 7.5),
        (stand, look.stands, 9.0, 14.0, 6.5),
        (sign, look.signs, 0.9, 2.2, 0.4),
    ):
        for s in rng.uniform(0.0, length, rng.poisson(density * length / 100.0)):
            side = rng.choice([-1.0, 1.0])
            offset = side * (wall + rng.uniform(near, far))
            site.put(make(rng), float(s), float(offset), clear)
    if look.posts:
        for s in np.arange(0.0, length, POST_STEP_M):
            for side in (-1.0, 1.0):
                site.put(marker_post(), float(s), side * (wall + 0.35), 0.1)
    if look.lamps:
        side = rng.choice([-1.0, 1.0])
        for s in np.arange(0.0, length, LAMP_STEP_M):
            site.put(lamp(), float(s), side * (wall + 1.0), 0.6)
    return _gathered(site)


def _gathered(site: _Site) -> Surface:
    """The triangles of all props, in order of s, with a chunk every CHUNK_M."""
    if not site.parts:
        site.parts, site.s = [np.zeros((3, 12))], [0.0]
    order = np.argsort(site.s, kind="stable")
    parts = [site.parts[k] for k in order]
    vertices = np.concatenate(parts)
    sizes = np.array([len(part) for part in parts])
    cell = (np.asarray(site.s)[order] / CHUNK_M).astype(np.int64)
    starts = np.flatnonzero(np.diff(cell, prepend=-1))
    first = (np.cumsum(sizes) - sizes)[starts]
    count = np.diff(np.append(first, len(vertices)))
    low = np.minimum.reduceat(vertices[:, :3], first, axis=0)
    high = np.maximum.reduceat(vertices[:, :3], first, axis=0)
    chunks = Chunks(
        (low + high) / 2.0,
        np.linalg.norm(high - low, axis=1) / 2.0,
        first[None].astype(np.int64),
        count[None].astype(np.int64),
    )
    indices = np.arange(len(vertices), dtype=np.uint32)
    return Surface(vertices.astype(np.float32), indices, chunks)
