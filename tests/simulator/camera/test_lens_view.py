"""Calibrating images of a board on the road, rendered through a lens, recovers that lens."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.camera import Camera, Light
from simulator.camera.core.mesh import Chunks, Mesh, Surface
from simulator.camera.core.optics import rotation
from simulator.camera.core.render_modes import CLASSES
from simulator.camera.scene import props
from simulator.camera.scene.solids import PLAIN, face
from simulator.camera.snapshot import standing_pose
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from trackfeatures.camera import CameraParameters

COLUMNS, ROWS, SQUARE_M = 9, 6, 0.25
"""Inner corners of the board, and a square's side."""
LENS = CameraParameters(
    960, 600, x=1.2, y=0.1, z=1.1, pitch_deg=4.0, roll_deg=1.5, yaw_deg=-3.0,
    matrix=(620.0, 615.0, 492.0, 288.0),
    distortion="opencv", coefficients=(-0.28, 0.09, 0.0008, -0.0006, 0.0),
)  # fmt: skip
BOARDS = [
    (ahead, left, turn)
    for ahead, left in ((4.9, 2.6), (4.7, 1.4), (5.2, 0.4))
    for turn in (-0.7, -0.3, 0.35, 0.75)
]
"""Places of the lower left corner in the car's frame, m, and turns, rad."""
FISHEYE = replace(
    LENS, matrix=(330.0, 328.0, 485.0, 290.0),
    distortion="fisheye", coefficients=(-0.03, 0.004, -0.001, 0.0),
)  # fmt: skip


def board(
    corner: NDArray[np.float64], turn: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A board that stands upright in the car's frame, its lower edge from `corner` (3,) to the
    right, turned by `turn` rad: triangles (T, 11), and its inner corners (ROWS * COLUMNS, 3)."""
    right, up = np.array([np.sin(turn), -np.cos(turn), 0.0]), np.array([0.0, 0.0, 1.0])
    parts = []
    for row in range(ROWS + 3):  # a white rim, and the squares within
        for column in range(COLUMNS + 3):
            rim = row in (0, ROWS + 2) or column in (0, COLUMNS + 2)
            colour = (0.6, 0.6, 0.6) if rim or (row + column) % 2 else (0.01, 0.01, 0.01)
            at = corner + SQUARE_M * (column * right + row * up)
            sides = [at, at + SQUARE_M * right, at + SQUARE_M * (right + up), at + SQUARE_M * up]
            parts.append(face(sides, [(0.0, 0.0)] * 4, colour, PLAIN)[:, :11])
    rows, columns = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
    inner = corner + SQUARE_M * (np.outer(columns + 2, right) + np.outer(rows + 2, up))
    return np.concatenate(parts), inner


def show(camera: Camera, pose: NDArray[np.float64], triangles: NDArray[np.float64]) -> None:
    """Put triangles (T, 11) of the car's frame into the camera's scene, in place of the triangles
    of the previous call."""
    turn, vertices = rotation(*pose[3:]), triangles.copy()
    vertices[:, :3] = triangles[:, :3] @ turn.T + pose[:3]
    vertices[:, 3:6] = triangles[:, 3:6] @ turn.T
    low, high = vertices[:, :3].min(0), vertices[:, :3].max(0)
    all_of_it = np.array([[0]]), np.array([[len(vertices)]])
    surface = Surface(
        vertices.astype(np.float32),
        np.arange(len(vertices), dtype=np.uint32),
        Chunks(low[None], high[None], *all_of_it, (1000.0,)),
    )
    graphics, scene = camera._graphics, camera._loaded.scene
    with graphics.turns:
        program = graphics.weather_program("prop", camera.light.weather, "plain")
        shown = Mesh(graphics, program, surface, props.LAYOUT)
        scene._solid = (shown, *(mesh for mesh in scene._solid if not hasattr(mesh, "added")))
        vars(shown)["added"] = True


def found_corners(picture: NDArray[np.uint8], expected: NDArray[np.float64]) -> NDArray[np.float32]:
    """The board's inner corners as OpenCV finds them, in the order of `expected`."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    found, corners = cv2.findChessboardCornersSB(
        grey, (COLUMNS, ROWS), None, cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
    )
    assert found
    grid = corners.reshape(ROWS, COLUMNS, 2)
    ways = [grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1]]
    best = min(ways, key=lambda way: np.abs(way.reshape(-1, 2) - expected).sum())
    return np.ascontiguousarray(best.reshape(-1, 2))


@pytest.fixture(scope="module")
def road() -> Road:
    return Road(find_track("oval"), 2)


@pytest.mark.slow
def test_a_board_rendered_on_the_road_is_calibrated_back(road: Road) -> None:
    light = Light.named("overcast", np.random.default_rng(1))
    pose = standing_pose(road, 60.0, 1.0, 0.03)
    flat = np.zeros((ROWS * COLUMNS, 3), np.float32)
    flat[:, :2] = SQUARE_M * np.stack(np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)[::-1], 1)
    seen = []
    with Camera(road, LENS, seed=3, light=light) as camera:
        for ahead, left, turn in BOARDS:
            triangles, inner = board(np.array([ahead, left, -LENS.cg_height_m]), turn)
            show(camera, pose, triangles)
            seen.append(found_corners(camera.render(pose), LENS.project(inner)))
            assert np.abs(seen[-1] - LENS.project(inner)).max() < 0.5
    _, k, _, turns, places = cv2.calibrateCamera(
        [flat] * len(seen), seen, (LENS.width, LENS.height), None, None
    )
    heights, pitches = [], []
    for turned, place in zip(turns, places, strict=True):
        matrix, _ = cv2.Rodrigues(turned)  # from the board's frame, x right, y up, z to the car
        eye = -matrix.T @ place.ravel()
        heights.append(eye[1] + 2 * SQUARE_M)
        ahead = matrix[2]
        pitches.append(np.degrees(np.arcsin(-ahead[1])))
    true = LENS.intrinsics()
    assert k[0, 0] == pytest.approx(true[0, 0], rel=0.003)
    assert k[1, 1] == pytest.approx(true[1, 1], rel=0.003)
    assert np.mean(heights) == pytest.approx(LENS.height_above_road_m, abs=0.01)
    assert np.mean(pitches) == pytest.approx(LENS.pitch_deg, abs=0.1)


def test_a_fisheye_is_black_beyond_what_one_view_covers(road: Road) -> None:
    """The lens has 1.6 px per degree: a ray at 72 degrees is 115 px from the middle."""
    focal = 1.6 * 180 / np.pi
    lens = replace(
        FISHEYE, width=321, height=240, matrix=(focal, focal, 160.0, 119.5),
        coefficients=(0.0,) * 4, pitch_deg=0.0, roll_deg=0.0, yaw_deg=0.0,
    )  # fmt: skip
    light = Light.named("overcast", np.random.default_rng(1))
    pose = standing_pose(road, 60.0, 1.0)
    with Camera(road, lens, seed=3, light=light) as camera:
        views = camera.render_views(pose, None, ("front", "front:class", "front:depth"))
    row = views["front"][119].max(axis=1)
    assert np.flatnonzero(row > 0)[[0, -1]] == pytest.approx([160 - 115, 160 + 115], abs=1)
    outside = np.hypot(*(np.indices((240, 321)) - np.array([119.5, 160.0])[:, None, None])) > 118
    assert (views["front"][outside] == 0).all()
    assert (views["front:class"][outside] == CLASSES.index("sky")).all()
    assert np.isinf(views["front:depth"][outside]).all()
    # The road 60 degrees below the axis: z = 1.35 m / tan(60 deg) ahead.
    assert views["front:depth"][119 + 96, 160] == pytest.approx(
        1.35 / np.tan(np.radians(59.7)), abs=0.03
    )


def test_an_off_centre_pinhole_is_a_part_of_a_wider_one(road: Road) -> None:
    light = Light.named("overcast", np.random.default_rng(1))
    pose = standing_pose(road, 60.0, 1.0)
    wide = CameraParameters()
    focal = wide.focal_px
    part = replace(wide, width=160, height=100, matrix=(focal, focal, 139.5 - 20, 104.5 - 90))
    pictures = []
    for camera_of in (wide, part):
        with Camera(road, camera_of, seed=3, light=light) as camera:
            pictures.append(camera.render(pose).astype(int))
    assert np.abs(pictures[0][90:190, 20:180] - pictures[1]).mean() < 0.5
