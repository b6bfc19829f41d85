"""Pictures by closed-form projection: boards, and straight roads with two markings."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from trackfeatures.camera import CameraParameters

Picture = NDArray[np.uint8]
BOARD_PX = 60
"""The texture of one square of a board."""


def chessboard(columns: int, rows: int) -> Picture:
    """Texture of a chessboard with this many inner corners and a white border one square wide."""
    squares = np.indices((rows + 1, columns + 1)).sum(axis=0) % 2 == 0
    board = np.where(squares, 0, 255).astype(np.uint8).repeat(BOARD_PX, 0).repeat(BOARD_PX, 1)
    return np.pad(board, BOARD_PX, constant_values=255)


def board_pictures(
    texture: Picture, lens: CameraParameters, folder: Path, count: int, seed: int
) -> list[Path]:
    """PNG files of the board seen through `lens` from random sides."""
    rng = np.random.default_rng(seed)
    rows, columns = np.indices((lens.height, lens.width))
    rays = lens.rays(np.column_stack([columns.ravel(), rows.ravel()]))
    high, wide = texture.shape
    paths = []
    for number in range(count):
        turn = cv2.Rodrigues(rng.uniform(-0.5, 0.5, 3))[0]
        size = np.array([wide, high]) / max(wide, high)
        distance = rng.uniform(1.1, 1.5) * lens.focal_px / lens.width
        # Middle of the board, whose longer side is 1 m: it moves through all parts of the picture.
        aside = np.array([0.18 * (number % 3 - 1), 0.11 * (number // 3 % 3 - 1)])
        middle = np.array([*(aside + rng.uniform(-0.03, 0.03, 2)), distance])
        plane = np.column_stack([turn[:, 0], turn[:, 1], middle - turn[:, :2] @ size / 2])
        x, y, w = np.linalg.solve(plane, rays.T)
        scale = max(wide, high)
        at = [(value / w * scale - 0.5).reshape(lens.height, lens.width) for value in (x, y)]
        drawn = cv2.remap(
            cv2.GaussianBlur(texture, (0, 0), 1.5),
            at[0].astype(np.float32),
            at[1].astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(110,),
        )
        paths.append(folder / f"{number}.png")
        cv2.imwrite(str(paths[-1]), drawn)
    return paths


def road_picture(
    camera: CameraParameters, markings_m: list[float], heading: float = 0.0
) -> Picture:
    """A grey road with white markings 0.12 m wide, `markings_m` to the left of a car that points
    `heading` rad to the left of the road."""
    picture = np.full((camera.height, camera.width, 3), 90, np.uint8)
    ahead = np.linspace(1.0, 90.0, 400)
    c, s = np.cos(heading), np.sin(heading)
    for middle in markings_m:
        sides = []
        for left in (middle - 0.06, middle + 0.06):
            road = np.column_stack([ahead, np.full_like(ahead, left)])
            car = road @ np.array([[c, -s], [s, c]])
            points = np.column_stack([car, np.full_like(ahead, -camera.cg_height_m)])
            sides.append(camera.project(points))
        shape = np.concatenate([sides[0], sides[1][::-1]])
        shape = np.clip(shape[np.isfinite(shape).all(axis=1)], -4000, 4000)
        cv2.fillPoly(
            picture, [np.rint(16 * shape).astype(np.int32)], (235,) * 3, cv2.LINE_AA, shift=4
        )
    return picture
