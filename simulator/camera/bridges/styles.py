"""Builds the triangles of bridges: decks, piers, railings, arches and gantries.

The bridge's frame has x along the road, y to the left and z up, in metres, with the origin on the
road's centre line. Each function in STYLES adds the parts of one kind of bridge to a
`BridgeBuilder`, which holds the width and heights of the place where the bridge stands.
"""

from collections.abc import Callable

import numpy as np

from simulator.arrays import FloatArray
from simulator.camera.scene.solids import BOARD, EARTH, MASONRY, PLAIN, Point, box, face

CONCRETE: tuple[Point, ...] = ((0.36, 0.35, 0.33), (0.42, 0.41, 0.38), (0.30, 0.30, 0.30))
STEEL: tuple[Point, ...] = (
    (0.06, 0.13, 0.10), (0.20, 0.09, 0.06), (0.11, 0.16, 0.22), (0.26, 0.27, 0.28),
    (0.42, 0.41, 0.38),
)  # fmt: skip
STONE: tuple[Point, ...] = ((0.27, 0.24, 0.20), (0.30, 0.29, 0.27), (0.24, 0.11, 0.07))
WOOD: Point = (0.17, 0.11, 0.06)
ADVERTS: tuple[Point, ...] = (
    (0.48, 0.03, 0.03), (0.02, 0.09, 0.36), (0.62, 0.46, 0.03), (0.60, 0.60, 0.58),
    (0.02, 0.02, 0.02),
)  # fmt: skip
ROAD_SIGNS: tuple[Point, ...] = ((0.02, 0.10, 0.34), (0.02, 0.17, 0.08))
NO_COLOUR: Point = (0.0, 0.0, 0.0)
SPAN_BEYOND_M = {"overpass": 13.0, "railway": 5.0, "footbridge": 3.0, "wooden": 3.0,
                 "adverts": 3.0, "arch": 5.0, "gantry": 1.4}  # fmt: skip
"""Distance (m) by which a bridge of each style extends beyond the wall line."""


class BridgeBuilder:
    """Collects the triangles of a bridge and the boxes that cast its shadow, in the bridge's frame.

    All arguments are in m, relative to the road's centre. `wall` is the distance to the wall lines,
    where the barriers stand. `under` is the least height of the deck's underside, `ground` the
    height of the lowest terrain at the bridge's ends.
    """

    def __init__(self, wall: float, under: float, ground: float) -> None:
        self.wall, self.under, self.ground = wall, under, ground
        self._parts: list[FloatArray] = []
        self._boxes: list[FloatArray] = []

    def box(self, size: Point, at: Point, colour: Point, material: float = PLAIN) -> None:
        """Add a closed box of `size` (x, y, z), m, and its shadow. `at` (x, y, z), m, is the middle
        of the box's floor. `colour` is linear RGB, `material` a material number of `solids`."""
        self.box_without_shadow(size, at, colour, material)
        self.shadow_box(size, at)

    def box_without_shadow(
        self, size: Point, at: Point, colour: Point, material: float = PLAIN
    ) -> None:
        """Add a closed box of `size` (x, y, z), m, without a shadow, for parts that are too thin to
        cast a visible shadow. `at` (x, y, z), m, is the middle of the box's floor. `colour` is
        linear RGB, `material` a material number of `solids`."""
        self._parts.append(box(size, at, colour, material, floor=True))

    def shadow_box(self, size: Point, at: Point) -> None:
        """Add a box of `size` (x, y, z), m, that casts a shadow but is not drawn. `at` (x, y, z),
        m, is the middle of the box's floor."""
        half = np.array([size[0] / 2, size[1] / 2, 0.0])
        self._boxes.append(np.array([at - half, at + half + np.array([0.0, 0.0, size[2]])]))

    def face(self, corners: list[FloatArray], colour: Point, material: float) -> None:
        """Add a face with four corners (3,), m, counter-clockwise seen from outside. `colour` is
        linear RGB, `material` a material number of `solids`. The texture coordinates are metres
        from the first corner."""
        right = corners[1] - corners[0]
        along = right / max(float(np.linalg.norm(right)), 1e-9)
        uv = []
        for corner in corners:
            off = corner - corners[0]
            u = float(off @ along)
            uv.append((u, float(np.linalg.norm(off - u * along))))
        self._parts.append(face(corners, uv, colour, material))

    def board(self, size: tuple[float, float], at: Point, colour: Point, facing: float) -> None:
        """Add a lettered board of `size` (width, height), m, that stands across the road, with the
        middle of its lower edge at `at` (x, y, z), m. `facing` is 1 if the board faces traffic
        along +x, -1 if it faces traffic along -x."""
        wide, high = size
        left, up = np.array([0.0, facing * wide / 2, 0.0]), np.array([0.0, 0.0, high])
        front = np.array(at) - np.array([0.045 * facing, 0.0, 0.0])
        corners = [front + left, front - left, front - left + up, front + left + up]
        self.box_without_shadow((0.08, wide, high), at, (0.2, 0.2, 0.2))
        self.shadow_box((0.25, wide, high), at)
        letters = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
        self._parts.append(face(corners, letters, colour, BOARD))

    def triangles(self) -> FloatArray:
        """Return all triangles as vertices (n, 12), three a triangle: position, normal, colour, u,
        v, material number."""
        return np.concatenate(self._parts)

    def boxes(self) -> FloatArray:
        """Return the boxes that cast a shadow, (m, 2, 3): the least and the greatest corner of each
        box in the bridge's frame, m."""
        return np.array(self._boxes).reshape(-1, 2, 3)


Style = Callable[[BridgeBuilder, np.random.Generator], None]
"""A function that adds the parts of one bridge to the builder, with random sizes and colours."""


def half_span(style: str, wall: float) -> float:
    """Return half of the length (m) across the road of a bridge of `style`, a key of STYLES,
    without embankments. `wall` (m) is the distance from the road's centre to the wall lines."""
    return wall + SPAN_BEYOND_M[style]


def _pick(rng: np.random.Generator, colours: tuple[Point, ...]) -> Point:
    return colours[int(rng.integers(len(colours)))]


def _railing(
    builder: BridgeBuilder, x: float, reach: float, foot: float, colour: Point, step: float
) -> None:
    """Add a railing across the road at `x` (m): two bars from -`reach` to `reach` (m), and posts,
    `step` (m) apart. `foot` (m) is the height of the foot of the posts, `colour` is linear RGB."""
    for height in (0.5, 1.02):
        builder.box_without_shadow((0.06, 2 * reach, 0.06), (x, 0.0, foot + height), colour)
    for y in np.arange(-reach, reach + 0.01, step):
        builder.box_without_shadow((0.06, 0.06, 1.05), (x, float(y), foot), colour)


def _mounds(builder: BridgeBuilder, width: float, reach: float, top: float, ground: float) -> None:
    """Add the embankments that lead to both ends of a deck. `width` (m) is the width of the deck,
    `reach` (m) the lateral distance of its ends, `top` (m) the height of its surface, and `ground`
    (m) the height of the lowest terrain."""
    low, spread = ground - 1.0, 1.4 * (top - ground)
    for side in (-1.0, 1.0):
        crest = _ring(width / 2 + 0.3, side * (reach - 0.6), side * (reach + 5.0), top)
        foot = _ring(
            width / 2 + spread,
            side * (reach - 0.6 - 0.25 * spread),
            side * (reach + 5 + spread),
            low,
        )
        for k in range(4):
            pair = [foot[k], foot[(k + 1) % 4], crest[(k + 1) % 4], crest[k]]
            builder.face(pair if side > 0 else pair[::-1], NO_COLOUR, EARTH)
        builder.face(crest if side > 0 else crest[::-1], NO_COLOUR, EARTH)


def _ring(x: float, y0: float, y1: float, z: float) -> list[FloatArray]:
    return [np.array([u, v, z]) for u, v in ((-x, y0), (x, y0), (x, y1), (-x, y1))]


def overpass(builder: BridgeBuilder, rng: np.random.Generator) -> None:
    """Add a concrete road on rows of columns to `builder`. `rng` gives the width and the colour."""
    wall, under, ground = builder.wall, builder.under, builder.ground
    width, depth = float(rng.uniform(7.0, 9.0)), 1.1
    reach, colour = half_span("overpass", wall), _pick(rng, CONCRETE)
    builder.box((width, 2 * reach, depth), (0.0, 0.0, under), colour, MASONRY)
    for x in (-width / 2, width / 2):
        builder.box((0.3, 2 * reach, 0.75), (x, 0.0, under + depth - 0.2), colour, MASONRY)
        _railing(builder, x, reach, under + depth + 0.1, (0.3, 0.3, 0.3), 2.5)
    for y in (-wall - 1.0, wall + 1.0):
        builder.box((width * 0.86, 0.9, 0.7), (0.0, y, under - 0.7), colour, MASONRY)
        for x in np.linspace(-0.34, 0.34, 3) * width:
            builder.box(
                (0.7, 0.7, under - ground + 0.6), (float(x), y, ground - 1.0), colour, MASONRY
            )
    _mounds(builder, width, reach, under + depth, ground)


def railway(builder: BridgeBuilder, rng: np.random.Generator) -> None:
    """Add a railway bridge of steel plate girders on masonry abutments to `builder`. `rng` gives
    the colours."""
    wall, under, ground = builder.wall, builder.under, builder.ground
    width, reach = 5.0, half_span("railway", wall)
    steel, stone = _pick(rng, STEEL), _pick(rng, STONE)
    builder.box((width, 2 * reach, 0.5), (0.0, 0.0, under), steel)
    for x in (-width / 2, width / 2):
        builder.box((0.25, 2 * reach, 1.7), (x, 0.0, under), steel)
        for y in np.arange(-reach, reach, 1.8):
            builder.box_without_shadow((0.5, 0.12, 1.7), (x, float(y), under), steel)
    for side in (-1.0, 1.0):
        height = under - ground + 2.0
        at = (0.0, side * (wall + 3.0), ground - 1.0)
        builder.box((width + 1.6, 4.0, height), (at[0], at[1], at[2]), stone, MASONRY)
    _mounds(builder, width, reach, under + 0.9, ground)


def footbridge(builder: BridgeBuilder, rng: np.random.Generator) -> None:
    """Add a narrow steel footbridge with stairs on both sides to `builder`. `rng` gives the
    colour."""
    _walkway(builder, "footbridge", _pick(rng, STEEL))


def wooden(builder: BridgeBuilder, rng: np.random.Generator) -> None:
    """Add a wooden footbridge with stairs on both sides to `builder`. `rng` is not used."""
    _walkway(builder, "wooden", WOOD)


def adverts(builder: BridgeBuilder, rng: np.random.Generator) -> None:
    """Add a footbridge with advertising boards along its whole length to `builder`, as on race
    tracks. `rng` gives the colour of the boards."""
    wall, under = builder.wall, builder.under
    _walkway(builder, "adverts", (0.30, 0.30, 0.31))
    reach, colour = half_span("adverts", wall), _pick(rng, ADVERTS)
    for x, facing in ((-1.42, 1.0), (1.42, -1.0)):
        count = max(2, round(2 * reach / 6.0))
        for k in range(count):
            y = (k + 0.5) * 2 * reach / count - reach
            builder.board((2 * reach / count, 1.7), (x, y, under - 0.05), colour, facing)


def _walkway(builder: BridgeBuilder, style: str, colour: Point) -> None:
    """Add a deck of 2.6 m width with railings, columns and stairs. `style`, a key of STYLES,
    determines its length; `colour` is linear RGB."""
    wall, under, ground = builder.wall, builder.under, builder.ground
    width, reach = 2.6, half_span(style, wall)
    builder.box((width, 2 * reach, 0.38), (0.0, 0.0, under), colour)
    for x in (-width / 2, width / 2):
        builder.box((0.12, 2 * reach, 0.6), (x, 0.0, under - 0.1), colour)
        _railing(builder, x, reach, under + 0.38, colour, 2.0)
    for side in (-1.0, 1.0):
        for x in (-0.9, 0.9):
            at = (x, side * (wall + 1.0), ground - 1.0)
            builder.box((0.34, 0.34, under - ground + 1.0), at, colour)
        _stairs(builder, side * (reach - 1.0), under + 0.38, ground, colour)


def _stairs(builder: BridgeBuilder, y: float, top: float, ground: float, colour: Point) -> None:
    """Add stairs that descend along the road from the deck's edge at the lateral offset `y` (m).
    They begin at the height `top` (m) and end at the height `ground` (m). `colour` is linear
    RGB."""
    steps = max(4, round((top - ground) / 0.5))
    for k in range(steps):
        z = top - (k + 1) * (top - ground) / steps
        builder.box_without_shadow((0.72, 1.7, 0.2), (1.6 + 0.7 * k, y, z), colour)
    run = 1.3 + 0.7 * steps
    for edge in (y - 0.85, y + 0.85):
        corners = [
            np.array([1.2, edge, top - 0.5]), np.array([1.2 + run, edge, ground - 0.5]),
            np.array([1.2 + run, edge, ground + 0.9]), np.array([1.2, edge, top + 0.9]),
        ]  # fmt: skip
        builder.face(corners, colour, PLAIN)


def gantry(builder: BridgeBuilder, rng: np.random.Generator) -> None:
    """Add a gantry to `builder`: two posts and a beam with two or three direction signs over the
    lanes. `rng` gives the number and the colour of the signs."""
    wall, under, ground = builder.wall, builder.under, builder.ground
    steel, reach = (0.34, 0.35, 0.36), wall + 0.8
    for y in (-reach, reach):
        builder.box((0.35, 0.35, under - ground + 2.6), (0.0, y, ground - 1.0), steel)
    for z in (under + 0.35, under + 1.35):
        builder.box((0.22, 2 * reach, 0.22), (0.0, 0.0, z), steel)
    for y in np.arange(-reach, reach, 1.5):
        builder.box_without_shadow((0.1, 0.1, 1.0), (0.0, float(y), under + 0.4), steel)
    colour, count = _pick(rng, ROAD_SIGNS), int(rng.integers(2, 4))
    for k in range(count):
        y = (k + 0.5) * 1.3 * wall / count - 0.65 * wall
        builder.board((1.05 * wall / count, 2.2), (-0.25, y, under), colour, 1.0)


def arch(builder: BridgeBuilder, rng: np.random.Generator) -> None:
    """Add a segmental arch of masonry under a level parapet to `builder`. `rng` gives the width and
    the colour."""
    wall, under, ground = builder.wall, builder.under, builder.ground
    width, reach, parts = float(rng.uniform(4.0, 6.0)), half_span("arch", wall), 20
    colour = _pick(rng, STONE)
    spring = wall + 0.6
    y = np.linspace(-spring, spring, parts + 1)
    rise = min(0.45 * under, 2.6)
    crown = under + rise * 0.45
    z = crown - rise * (y / spring) ** 2
    top = crown + 1.6
    for a, b, za, zb in zip(y[:-1], y[1:], z[:-1], z[1:], strict=True):
        _arch_part(builder, width, (a, b), (za, zb), top, colour)
    for side in (-1.0, 1.0):
        height = top - ground + 1.0
        at = (0.0, side * (spring + (reach - spring) / 2), ground - 1.0)
        builder.box((width, reach - spring, height), at, colour, MASONRY)
    coping = (0.8 * colour[0], 0.8 * colour[1], 0.8 * colour[2])
    builder.box((width + 0.35, 2 * reach, 0.25), (0.0, 0.0, top), coping, MASONRY)
    _mounds(builder, width, reach, top - 0.9, ground)


def _arch_part(
    builder: BridgeBuilder,
    width: float,
    y: tuple[float, float],
    z: tuple[float, float],
    top: float,
    colour: Point,
) -> None:
    """Add one part of an arch, of `width` m: the vault and the side walls between two points of the
    arch's curve. `y` (m) and `z` (m) are the lateral offsets and the heights of the two points,
    `top` (m) is the height of the walls' upper edge, `colour` is linear RGB."""
    for x, turn in ((-width / 2, -1), (width / 2, 1)):
        near, far = (y[0], z[0]), (y[1], z[1])
        if turn < 0:
            near, far = far, near
        corners = [np.array([x, *near]), np.array([x, *far])]
        corners += [np.array([x, far[0], top]), np.array([x, near[0], top])]
        builder.face(corners, colour, MASONRY)
    x = width / 2
    vault = [(-x, y[0], z[0]), (-x, y[1], z[1]), (x, y[1], z[1]), (x, y[0], z[0])]
    builder.face([np.array(corner) for corner in vault], colour, MASONRY)
    low = min(z)
    builder.shadow_box((width, y[1] - y[0], top - low), (0.0, (y[0] + y[1]) / 2, low))


STYLES: dict[str, Style] = {
    "overpass": overpass, "railway": railway, "footbridge": footbridge, "wooden": wooden,
    "adverts": adverts, "gantry": gantry, "arch": arch,
}  # fmt: skip
