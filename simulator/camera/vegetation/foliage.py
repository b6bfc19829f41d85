"""Paints the tree textures once per process into an atlas of square cells, one for each kind of
tree. RGB is the square root of the linear colour; alpha is linear. The module also computes the
outlines of the trees.

Frame of an outline: x from -0.5 to 0.5, y from 0 (foot) to 1, as in tree.vert.glsl.
"""

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray

CELL = 128
COLUMNS, ROWS = 4, 2
KINDS: tuple[str, ...] = ("oak", "poplar", "pine", "fir", "palm", "bush", "crown", "birch")
"""Kinds of trees in the order of their cells, row by row; `crown` is any tree seen from above."""
ASPECT = {
    "oak": 0.95, "poplar": 0.36, "pine": 0.62, "fir": 0.5, "palm": 0.8, "bush": 1.5, "birch": 0.6,
}  # fmt: skip
"""Width divided by height of a tree of each kind."""

_FINE = 2
"""Supersampling factor of the cells; it gives soft edges."""
_BARK = np.array([70.0, 55.0, 42.0])
CORNERS = 6
_BLEED = 4
"""Number of texels by which mipmaps spread the alpha. The outline keeps this distance from the
visible part of a tree."""
Canvas = NDArray[np.float32]


@cache
def atlas() -> NDArray[np.uint8]:
    """Paint the atlas (256, 512, 4) uint8 RGBA, 2 rows of 4 cells of 128 x 128 texels. Row 0 is the
    top row."""
    rng = np.random.default_rng(77)
    painters = {
        "oak": _oak, "poplar": _poplar, "pine": _pine, "fir": _fir,
        "palm": _palm, "bush": _bush, "crown": _crown, "birch": _birch,
    }  # fmt: skip
    sheet = np.zeros((ROWS * CELL, COLUMNS * CELL, 4), dtype=np.uint8)
    for number, kind in enumerate(KINDS):
        canvas = np.zeros((CELL * _FINE, CELL * _FINE, 4), dtype=np.float32)
        painters[kind](canvas, rng)
        row, column = divmod(number, COLUMNS)
        top, left = row * CELL, column * CELL
        sheet[top : top + CELL, left : left + CELL] = _finished(canvas)
    return sheet


def silhouettes() -> NDArray[np.uint8]:
    """Return the alpha (kinds, 128, 128) uint8 of the pictures of trees, in the order of KINDS; 255
    is opaque."""
    alpha = atlas()[..., 3].reshape(ROWS, CELL, COLUMNS, CELL).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(alpha.reshape(-1, CELL, CELL))


@cache
def outlines() -> FloatArray:
    """Return convex polygons (kinds, 6, 2) round the pictures of trees, in the order of KINDS and
    in the frame of an outline."""
    return np.stack([outline(shape) for shape in silhouettes()])


def _finished(canvas: Canvas) -> NDArray[np.uint8]:
    """Return the cell (CELL, CELL, 4) uint8: `canvas` averaged to cell size, with the leaf colour
    extended into transparent texels, so that filtered edges keep it."""
    alpha = canvas[..., 3:]
    premultiplied = np.concatenate([canvas[..., :3] * alpha, alpha], axis=-1)
    small = cv2.resize(premultiplied, (CELL, CELL), interpolation=cv2.INTER_AREA)
    spread = cv2.GaussianBlur(small, (0, 0), 6.0)
    mean = premultiplied.sum(axis=(0, 1))
    fallback = mean[:3] / mean[3]
    colour = np.where(
        small[..., 3:] > 0.02,
        small[..., :3] / np.maximum(small[..., 3:], 0.02),
        np.where(
            spread[..., 3:] > 1e-3, spread[..., :3] / np.maximum(spread[..., 3:], 1e-3), fallback
        ),
    )
    small_alpha = small[..., 3:] * 255.0
    # The transparent rim keeps colours of neighbouring cells out of the mipmaps.
    small_alpha[[0, 1, -1], :] = 0.0
    small_alpha[:, [0, 1, -2, -1]] = 0.0
    return np.concatenate([np.clip(colour, 0, 255), small_alpha], axis=-1).astype(np.uint8)


def _disc(canvas: Canvas, x: float, y: float, radius: float, colour: FloatArray) -> None:
    """Draw an opaque disc on `canvas`. `x`, `y` and `radius` are shares of the cell's side; the
    origin is the cell's lower left corner."""
    size = canvas.shape[0]
    centre = (round(x * size), round((1.0 - y) * size))
    cv2.circle(canvas, centre, max(1, round(radius * size)), (*colour.tolist(), 1.0), -1)


def _trunk(canvas: Canvas, top: float, width: float, bark: FloatArray = _BARK) -> None:
    """Draw a trunk of the colour `bark` on `canvas` up to the height `top`. `width` is half its
    width at the foot. Both lengths are shares of the cell's side."""
    size = canvas.shape[0]
    for k in range(24):
        share = k / 23
        thick = width * (1.0 - 0.5 * share)
        left, right = round((0.5 - thick) * size), round((0.5 + thick) * size)
        low = round((1.0 - top * share) * size)
        cv2.line(canvas, (left, low), (right, low), (*bark.tolist(), 1.0), round(size * top / 18))


def _leaves(
    canvas: Canvas,
    rng: np.random.Generator,
    clusters: list[tuple[float, float, float, float]],
    count: int,
    leaf: float,
    colour: tuple[float, float, float],
) -> None:
    """Draw `count` random discs on `canvas` in each of the elliptic `clusters`, given by centre and
    half axes (x, y, rx, ry) as shares of the cell's side. Dark discs are drawn first, then lighter
    discs, which lie higher. `leaf` is the mean radius of a disc as a share of the cell's side."""
    base = np.array(colour)
    spots = []
    for x, y, rx, ry in clusters:
        angle = rng.uniform(0, 2 * np.pi, count)
        reach = np.sqrt(rng.uniform(0, 1, count))
        u, v = reach * np.cos(angle), reach * np.sin(angle)
        light = 0.62 + 0.30 * v + 0.12 * rng.standard_normal(count)
        spots += list(zip(x + rx * u, y + ry * v, light, strict=True))
    spots.sort(key=lambda spot: spot[2])
    for x, y, light in spots:
        shade = float(np.clip(light, 0.25, 1.15))
        _disc(canvas, x, y, leaf * rng.uniform(0.6, 1.3), np.clip(base * shade, 0, 255))


def _oak(canvas: Canvas, rng: np.random.Generator) -> None:
    _trunk(canvas, 0.45, 0.028)
    clusters = [(0.5, 0.62, 0.36, 0.26), (0.3, 0.5, 0.22, 0.16), (0.7, 0.5, 0.22, 0.17)]
    clusters += [(0.42, 0.8, 0.24, 0.14), (0.6, 0.78, 0.22, 0.15)]
    _leaves(canvas, rng, clusters, 210, 0.022, (96, 128, 58))


def _poplar(canvas: Canvas, rng: np.random.Generator) -> None:
    _trunk(canvas, 0.3, 0.05)
    clusters = [(0.5, y, rx, 0.13) for y, rx in ((0.25, 0.28), (0.42, 0.38), (0.6, 0.36))]
    clusters += [(0.5, 0.76, 0.26, 0.12), (0.5, 0.89, 0.13, 0.08)]
    _leaves(canvas, rng, clusters, 150, 0.024, (88, 124, 56))


def _pine(canvas: Canvas, rng: np.random.Generator) -> None:
    _trunk(canvas, 0.85, 0.028, np.array([105.0, 72.0, 50.0]))
    clusters = [
        (0.5 + rng.uniform(-0.16, 0.16), y, 0.2 + 0.14 * (1 - abs(y - 0.62) * 3), 0.065)
        for y in np.linspace(0.42, 0.92, 8)
    ]
    _leaves(canvas, rng, clusters, 90, 0.02, (66, 98, 58))


def _fir(canvas: Canvas, rng: np.random.Generator) -> None:
    _trunk(canvas, 0.2, 0.035)
    for y in np.linspace(0.12, 0.95, 16):
        half = 0.44 * (1.0 - (y - 0.1) / 0.9) + 0.03
        for _ in range(130):
            u = rng.uniform(-1, 1)
            light = 0.55 + 0.35 * y + 0.2 * rng.standard_normal() - 0.12 * abs(u)
            colour = np.array([58.0, 88.0, 55.0]) * np.clip(light, 0.3, 1.2)
            drop = 0.075 * abs(u) + rng.uniform(-0.02, 0.02)
            _disc(canvas, 0.5 + half * u, y - drop, 0.02, colour)


def _palm(canvas: Canvas, rng: np.random.Generator) -> None:
    _trunk(canvas, 0.74, 0.019, np.array([118.0, 98.0, 74.0]))
    for angle in np.linspace(-0.5, np.pi + 0.5, 15):
        reach = rng.uniform(0.3, 0.44)
        bright = np.clip(0.8 + 0.25 * np.sin(angle) + 0.1 * rng.standard_normal(), 0.5, 1.2)
        for share in np.linspace(0.0, 1.0, 30):
            x = 0.5 + reach * share * np.cos(angle)
            y = 0.74 + reach * share * np.sin(angle) * 0.7 - 0.3 * share * share * reach / 0.4
            _disc(canvas, x, y, 0.036 * (1.15 - share), np.array([92.0, 122.0, 58.0]) * bright)


def _bush(canvas: Canvas, rng: np.random.Generator) -> None:
    clusters = [(x, 0.28, 0.2, 0.28) for x in (0.22, 0.4, 0.6, 0.78)]
    clusters += [(0.5, 0.5, 0.26, 0.26), (0.34, 0.42, 0.2, 0.22)]
    _leaves(canvas, rng, clusters, 110, 0.028, (92, 122, 60))


def _crown(canvas: Canvas, rng: np.random.Generator) -> None:
    clusters = [(0.5, 0.5, 0.36, 0.36), (0.5, 0.5, 0.2, 0.2)]
    clusters += [
        (0.5 + 0.28 * np.cos(a), 0.5 + 0.28 * np.sin(a), 0.15, 0.15) for a in np.arange(7) * 0.9
    ]
    _leaves(canvas, rng, clusters, 110, 0.026, (90, 124, 58))


def _birch(canvas: Canvas, rng: np.random.Generator) -> None:
    _trunk(canvas, 0.8, 0.018, np.array([178.0, 174.0, 164.0]))
    clusters = [(0.5 + rng.uniform(-0.2, 0.2), y, 0.2, 0.09) for y in np.linspace(0.38, 0.88, 9)]
    _leaves(canvas, rng, clusters, 90, 0.02, (116, 142, 66))


def outline(alpha: NDArray[np.uint8]) -> FloatArray:
    """Return a convex polygon (6, 2) round the visible part of one cell, in the frame of an
    outline. `alpha` (size, size) is the alpha of the cell. Equal corners at the end fill up a
    polygon with fewer corners."""
    size = alpha.shape[0]
    spread = cv2.dilate((alpha > 0).astype(np.uint8), np.ones((2 * _BLEED + 1,) * 2, np.uint8))
    points = cv2.findNonZero(spread).reshape(-1, 2)
    # A texel is a square, so all four of its corners must be inside the polygon.
    squares = np.concatenate(
        [points + np.array(shift) for shift in ((0, 0), (1, 0), (0, 1), (1, 1))]
    )
    hull = cv2.convexHull(squares.astype(np.int32)).reshape(-1, 2) / size
    polygon = np.column_stack([hull[:, 0] - 0.5, 1.0 - hull[:, 1]])
    while len(polygon) > CORNERS:
        polygon = _one_fewer(polygon)
    return np.concatenate([polygon, np.repeat(polygon[-1:], CORNERS - len(polygon), axis=0)])


def _one_fewer(polygon: FloatArray) -> FloatArray:
    """Remove one edge of the polygon and extend its two neighbours until they meet. Of all edges,
    remove the one for which this adds the least area."""
    best, least = polygon, np.inf
    for k in range(len(polygon)):
        before, a, b, after = (polygon[(k + shift) % len(polygon)] for shift in (-1, 0, 1, 2))
        meeting = _meeting(before, a, after, b)
        if meeting is None or np.abs(meeting - [0.0, 0.5]).max() > 0.5:
            continue
        area = abs(_cross(b - a, meeting - a))
        if area < least:
            kept = np.delete(polygon, (k + 1) % len(polygon), axis=0)
            kept[k - (k == len(polygon) - 1)] = meeting
            best, least = kept, area
    if best is polygon:  # no two edges meet within the cell, so the whole cell is the outline
        return np.array([[-0.5, 0.0], [0.5, 0.0], [0.5, 1.0], [-0.5, 1.0]])
    return best


def _meeting(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray | None:
    """Return the point where the lines from a through b and from c through d meet beyond b and d;
    None if there is no such point."""
    u, v = b - a, d - c
    slope = _cross(u, v)
    if abs(slope) < 1e-12:
        return None
    share, other = _cross(c - a, v) / slope, _cross(c - a, u) / slope
    return np.asarray(a + share * u) if share >= 1.0 and other >= 1.0 else None


def _cross(a: FloatArray, b: FloatArray) -> float:
    return float(a[0] * b[1] - a[1] * b[0])
