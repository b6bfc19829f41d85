"""The camera: pictures of a road and the cars on it, from a pose. World frame, metres, radians."""

from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simulator.camera import optics
from simulator.camera.cars import cars_of
from simulator.camera.context import FRAME_BINDING, Graphics, graphics
from simulator.camera.light import Light
from simulator.camera.optics import DRIVER_SEAT, Mount
from simulator.camera.scene import Scene
from simulator.car import CarParameters
from simulator.track.road import Road
from trackfeatures.errors import UserError

FloatArray = NDArray[np.float64]
Picture = NDArray[np.uint8]

MAX_SIZE = 4096
_OWN_PAINT = 0


class Camera:
    """Draws one scene: `road` with the scenery of `seed` under `light`.

    Cameras of a process share one OpenGL context (see `context`); use them from one thread. The
    same road, seed, light, pose and cars give the same bytes on the same renderer.
    Raises UserError for a picture size out of range, NoRendererError without EGL.
    """

    def __init__(
        self,
        road: Road,
        *,
        seed: int,
        light: Light,
        mount: Mount = DRIVER_SEAT,
        width: int = 280,
        height: int = 210,
    ) -> None:
        if not (8 <= width <= MAX_SIZE and 8 <= height <= MAX_SIZE):
            raise UserError(
                f"picture size {width} x {height}; each side must be 8 to {MAX_SIZE} pixels"
            )
        self.road, self.light, self.mount = road, light, mount
        self.width, self.height = width, height
        self._graphics: Graphics = graphics()
        self._cars = cars_of(self._graphics)
        self._scene: Scene | None = Scene(self._graphics, road, seed, light)
        # Cars of different rounds differ in colour; from the second on, so as to spare our own.
        self._first_paint = 1 + seed % 5
        self._last_s: float | None = None
        self._buffer = bytearray(width * height * 3)

    def render(
        self, body_pose: ArrayLike, others: ArrayLike | None = None, view: str = "front"
    ) -> Picture:
        """The picture (height, width, 3) uint8 RGB of `view` from a car at `body_pose`.

        `body_pose` (6,) is x, y, z, roll, pitch, yaw of the centre of gravity; `others` (n, 6)
        the same of other cars, z at the ground they stand on.
        """
        scene = self._open_scene()
        eye = optics.eye_of(self.mount, body_pose, view)
        matrix = self.intrinsics
        target = self._graphics.target(self.width, self.height)
        self._set_frame(eye, matrix)
        self._graphics.begin(target)
        planes = optics.frustum(eye, matrix)
        cars, paints = self._cars_in_view(body_pose, others, view)
        chosen = self._cars.seen(cars, eye.place, planes)
        self._cars.draw(cars[chosen], [paints[k] for k in chosen], eye.place)
        scene.draw(eye.place, planes)
        self._graphics.sky.render()
        self._graphics.blend()
        self._cars.draw_shadows(cars[chosen], eye.place, self.light)
        scene.draw_blended(eye.place, planes)
        if target.resolved is not target.drawn:
            self._graphics.context.copy_framebuffer(target.resolved, target.drawn)
        target.resolved.read_into(self._buffer, components=3, alignment=1)
        picture = np.frombuffer(self._buffer, dtype=np.uint8)
        return picture.reshape(self.height, self.width, 3).copy()

    @property
    def intrinsics(self) -> FloatArray:
        """Pinhole matrix (3, 3) in pixels; square pixels, principal point in the middle."""
        return optics.intrinsics(self.mount, self.width, self.height)

    def project(
        self, points: ArrayLike, body_pose: ArrayLike, view: str = "front"
    ) -> tuple[FloatArray, FloatArray]:
        """Pixels (N, 2) (u right, v down; NaN behind the eye) and depth (N,) m of world points."""
        return optics.project(optics.eye_of(self.mount, body_pose, view), self.intrinsics, points)

    def close(self) -> None:
        """Free the scene's graphics memory; the camera draws no more."""
        if self._scene is not None:
            self._scene.release()
            self._scene = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def shadow_fraction(self, body_pose: ArrayLike) -> float:
        """Share (0 to 1) of the road within 30 m ahead of the car that lies in hard shadow."""
        pose = np.asarray(body_pose, dtype=np.float64)
        s, _ = self.road.track.project(float(pose[0]), float(pose[1]), self._last_s)
        self._last_s = s
        return self._open_scene().mask.fraction(s, self.road.half_asphalt)

    def _cars_in_view(
        self, body_pose: ArrayLike, others: ArrayLike | None, view: str
    ) -> tuple[FloatArray, list[int]]:
        """Poses (n, 6) on the ground of the cars to draw, and the number of each one's paint."""
        poses = np.asarray(() if others is None else others, dtype=np.float64).reshape(-1, 6)
        paints = [self._first_paint + k for k in range(len(poses))]
        if view in ("chase", "top"):
            own = np.asarray(body_pose, dtype=np.float64).copy()
            own[:3] -= optics.rotation(*own[3:])[:, 2] * CarParameters.cg_height
            poses, paints = np.vstack([poses, own]), [*paints, _OWN_PAINT]
        return poses, paints

    def _open_scene(self) -> Scene:
        if self._scene is None:
            raise RuntimeError("this camera is closed; make a new one")
        return self._scene

    def _set_frame(self, eye: optics.Eye, matrix: FloatArray) -> None:
        """Fill the uniform block `Frame` of frame.glsl."""
        right, up, ahead = eye.axes
        light = self.light
        block = np.zeros(56, dtype=np.float32)
        clip = optics.clip_matrix(eye, matrix, self.width, self.height)
        block[:16] = clip.T.reshape(-1)
        rows = block[16:].reshape(10, 4)
        rows[0, :3] = eye.place
        rows[1, :3] = ahead
        rows[2, :3] = right * matrix[0, 2] / matrix[0, 0]
        # The picture is drawn upside down: image rows run downwards in the world.
        rows[3, :3] = -up * matrix[1, 2] / matrix[1, 1]
        rows[4] = (*light.sun_direction, light.shade)
        rows[5] = (*light.sun, light.exposure)
        rows[6] = (*light.sky, light.haze_per_km / 1000.0 / np.log(2.0))
        rows[7] = (*light.zenith, light.clouds)
        rows[8, :3] = light.horizon
        rows[9, :3] = light.haze
        self._graphics.frame.write(block.tobytes())
        self._graphics.frame.bind_to_uniform_block(FRAME_BINDING)
