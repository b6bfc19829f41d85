"""Camera views and the pinhole projection.

Body frame: x ahead, y to the left, z up, origin at the centre of gravity, metres. A body pose is
(x, y, z, roll, pitch, yaw) with PyBullet's Euler angles in rad (R = Rz Ry Rx, pitch positive nose
down). Image frame: pixels, u to the right, v down; the centre of a pixel has whole coordinates.
`lens_view` adds the distortion of a lens to the pinhole pictures.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from runtime.jit import compiled
from simulator.arrays import FloatArray
from trackfeatures import lens
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

VIEWS: tuple[str, ...] = ("front", "left", "right", "rear", "chase", "top")
"""Names of the views. `front` is the driver view, `chase` looks at the car from behind and above,
and `top` looks straight down."""

NEAR_M = 0.12
FAR_M = 6000.0

_YAW_DEG = {"front": 0.0, "left": 90.0, "right": -90.0, "rear": 180.0}
_CHASE_BACK_M, _CHASE_UP_M, _CHASE_PITCH_DEG = 7.5, 2.9, 12.0
_TOP_UP_M = 24.0


@dataclass(frozen=True)
class Eye:
    """A camera pose in the world: position `place` (3,) m and `axes` (3, 3), whose rows are the
    unit vectors to the right, up and ahead."""

    place: FloatArray
    axes: FloatArray


@compiled
def rotation(roll: float, pitch: float, yaw: float) -> FloatArray:
    """Return the rotation matrix (3, 3) from the body frame to the world, Rz(yaw) Ry(pitch)
    Rx(roll), angles in rad. PyBullet's getMatrixFromQuaternion gives the same matrix."""
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def eye_of(camera: CameraParameters, body_pose: ArrayLike, view: str) -> Eye:
    """Return the pose in the world of the camera that shows `view` from a car at `body_pose` (6,).
    Raises UserError unless `view` is one of VIEWS."""
    pose = np.asarray(body_pose, dtype=np.float64)
    yaw = float(pose[5])
    if view == "chase":
        # The view `chase` follows the car's yaw, but not its roll.
        turn = rotation(0.0, math.radians(_CHASE_PITCH_DEG), yaw)
        back = rotation(0.0, float(pose[4]), yaw) @ np.array([-_CHASE_BACK_M, 0.0, 0.0])
        return _eye(pose[:3] + back + np.array([0.0, 0.0, _CHASE_UP_M]), turn)
    if view == "top":
        return _eye(pose[:3] + np.array([0.0, 0.0, _TOP_UP_M]), rotation(0.0, math.pi / 2, yaw))
    if view not in _YAW_DEG:
        raise UserError(f"unknown camera view '{view}'; the views are {', '.join(VIEWS)}")
    body = rotation(float(pose[3]), float(pose[4]), yaw)
    turn = rotation(
        math.radians(camera.roll_deg),
        math.radians(camera.pitch_deg),
        math.radians(camera.yaw_deg + _YAW_DEG[view]),
    )
    return _eye(pose[:3] + body @ np.array([camera.x, camera.y, camera.z]), body @ turn)


def _eye(place: FloatArray, turn: FloatArray) -> Eye:
    """Return an eye at `place`; `turn` (3, 3) rotates its frame (x ahead, y left) to the world."""
    axes = np.empty((3, 3))
    axes[0], axes[1], axes[2] = -turn[:, 1], turn[:, 2], turn[:, 0]
    return Eye(place, axes)


def extrinsics(camera: CameraParameters, body_pose: ArrayLike, view: str) -> FloatArray:
    """Return the matrix (4, 4) from the body frame to the camera frame (x right, y down, z ahead,
    m) of `view`. `body_pose` (6,) matters only for the views `chase` and `top`, which stay
    level."""
    pose = np.asarray(body_pose, dtype=np.float64)
    eye = eye_of(camera, pose, view)
    right, up, ahead = eye.axes
    turn = np.stack([right, -up, ahead])
    matrix = np.eye(4)
    matrix[:3, :3] = turn @ rotation(*pose[3:])
    matrix[:3, 3] = turn @ (pose[:3] - eye.place)
    return matrix


def project(eye: Eye, camera: CameraParameters, points: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Project world points (N, 3) m: returns pixels (N, 2) and depth (N,) in m along the optical
    axis. Pixels are NaN for points behind the eye and outside the lens's field of view."""
    places = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    if camera.distortion == "none":
        return _pixels(places, eye.place, eye.axes, camera.intrinsics())
    right, up, ahead = eye.axes @ (places - eye.place).T
    return lens.project(camera, np.column_stack([right, -up, ahead])), ahead


@compiled
def _pixels(
    points: FloatArray, eye: FloatArray, axes: FloatArray, matrix: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Project world `points` (N, 3), m, to pixels, without distortion, in a compiled loop, which is
    faster than numpy for a few hundred points. `eye` (3,), m, is the viewpoint; `axes` (3, 3) as in
    `Eye`; `matrix` (3, 3) are the intrinsics."""
    pixels, depth = np.empty((len(points), 2)), np.empty(len(points))
    for k in range(len(points)):
        x, y, z = points[k, 0] - eye[0], points[k, 1] - eye[1], points[k, 2] - eye[2]
        right = x * axes[0, 0] + y * axes[0, 1] + z * axes[0, 2]
        up = x * axes[1, 0] + y * axes[1, 1] + z * axes[1, 2]
        ahead = x * axes[2, 0] + y * axes[2, 1] + z * axes[2, 2]
        depth[k] = ahead
        if ahead > 1e-6:
            pixels[k, 0] = matrix[0, 2] + matrix[0, 0] * right / ahead
            pixels[k, 1] = matrix[1, 2] - matrix[1, 1] * up / ahead
        else:
            pixels[k] = np.nan
    return pixels, depth


def clip_matrix(eye: Eye, matrix: FloatArray, width: int, height: int) -> FloatArray:
    """Return the matrix (4, 4) from world coordinates relative to the eye to clip space, for column
    vectors and the intrinsics `matrix` (3, 3).

    The image is flipped against OpenGL's convention: the first row in memory is the top row.
    """
    x_scale = 2.0 * matrix[0, 0] / width
    y_scale = 2.0 * matrix[1, 1] / height
    clip = np.zeros((4, 4))
    # Offset of the principal point from the picture's middle, in half sides; 0 if it is centred.
    aside, below = ((2.0 * matrix[k, 2] + 1.0) / (width, height)[k] - 1.0 for k in (0, 1))
    clip[0, :3] = eye.axes[0] * x_scale + eye.axes[2] * aside
    clip[1, :3] = -eye.axes[1] * y_scale + eye.axes[2] * below
    clip[2, :3] = eye.axes[2] * (FAR_M + NEAR_M) / (FAR_M - NEAR_M)
    clip[2, 3] = -2.0 * FAR_M * NEAR_M / (FAR_M - NEAR_M)
    clip[3, :3] = eye.axes[2]
    return clip


def frustum(eye: Eye, matrix: FloatArray, width: int, height: int) -> FloatArray:
    """Return the inward unit normals (4, 3) of the side planes through the eye, for a view of
    `width` x `height` px with the intrinsics `matrix` (3, 3)."""
    left, up = ((matrix[k, 2] + 0.5) / matrix[k, k] for k in (0, 1))
    right, down = width / matrix[0, 0] - left, height / matrix[1, 1] - up
    sides = np.array([[-1.0, 0.0, right], [1.0, 0.0, left], [0.0, -1.0, up], [0.0, 1.0, down]])
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    return np.asarray(sides @ eye.axes)
