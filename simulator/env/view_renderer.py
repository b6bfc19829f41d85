"""An environment's pictures: one camera, made when first needed; each view drawn once a step."""

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from simulator.track.road import Road
from simulator.vehicle.state import CarState
from simulator.world.world import World
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from simulator.camera import Camera


@dataclass(frozen=True)
class PictureOptions:
    """An environment's pictures; their scenery and light depend on `light_seed` only."""

    width: int = 280
    height: int = 210
    light: str = "clear"
    """A kind of light and weather by its name."""

    light_seed: int = 0
    mount: CameraParameters | None = None
    """Place, pitch and lens of the driver camera, whose size is `width` and `height`; None is the
    driver's seat."""

    render_view: str = "front"
    """The view in colour that `render()` shows."""

    def __post_init__(self) -> None:
        from simulator.camera import VIEWS, check_light, check_size

        check_size(self.width, self.height)
        check_light(self.light)
        if self.render_view not in VIEWS:
            raise UserError(
                f"render_view is {self.render_view!r}; the views are {', '.join(VIEWS)}"
            )

    @property
    def camera(self) -> CameraParameters:
        mount = self.mount or CameraParameters()
        return replace(mount, width=self.width, height=self.height)


class Pictures:
    """Views of a world by name, each drawn at most once for one moment."""

    def __init__(self, road: Road, options: PictureOptions) -> None:
        self._road, self._options = road, options
        self._camera: Camera | None = None
        self._moment: CarState | None = None
        self._drawn: dict[str, NDArray[Any]] = {}

    def space(self, view: str) -> gym.spaces.Box:
        """Of the pictures of `view`. Raises UserError for an unknown one."""
        from simulator.camera.core.optics import FAR_M
        from simulator.camera.core.render_modes import CLASS, CLASSES, DEPTH, ViewRequest

        height, width, _ = self.shape
        kind = ViewRequest.of(view).kind
        if kind == DEPTH:
            return gym.spaces.Box(0.0, FAR_M, (height, width), np.float32)
        if kind == CLASS:
            return gym.spaces.Box(0, len(CLASSES) - 1, (height, width), np.uint8)
        return gym.spaces.Box(0, 255, self.shape, np.uint8)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(height, width, 3) of a picture in colour."""
        return self._options.height, self._options.width, 3

    def take(self, world: World, views: Sequence[str]) -> dict[str, NDArray[Any]]:
        """The views of the present moment, in the order asked for; the caller's to keep.

        As `Camera.render_views` has them, but the sky is as far as the space goes, 6000 m.
        """
        if world.state is not self._moment:
            self._moment, self._drawn = world.state, {}
        missing = [view for view in views if view not in self._drawn]
        if missing:
            self._drawn |= self._draw(world, missing)
        return {view: self._drawn[view].copy() for view in views}

    def _draw(self, world: World, views: Sequence[str]) -> dict[str, NDArray[Any]]:
        from simulator.camera.core.optics import FAR_M

        drawn = self.camera.render_views(world.body_pose(), world.traffic.poses(), views)
        for picture in drawn.values():
            if picture.dtype == np.float32:
                np.minimum(picture, FAR_M, out=picture)
        return drawn

    def calibration(self, views: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """`intrinsics` (3, 3) in pixels, and by each view's name its extrinsics (4, 4), from the
        body frame to the camera's; see `Camera.extrinsics`. Draws nothing."""
        from simulator.camera.core.optics import extrinsics
        from simulator.camera.core.render_modes import ViewRequest

        camera = self._options.camera
        at_rest = np.zeros(6)
        by_view = {view: extrinsics(camera, at_rest, ViewRequest.of(view).view) for view in views}
        return {"intrinsics": camera.intrinsics()} | by_view

    @property
    def camera(self) -> "Camera":
        """The camera; making it draws the scenery and takes a moment."""
        if self._camera is None:
            self._camera = _make_camera(self._road, self._options)
            # Graphics memory of an environment that is dropped without close() comes back too.
            weakref.finalize(self, self._camera.close).atexit = False
        return self._camera

    def close(self) -> None:
        """Free the graphics memory; another picture makes a new camera."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        self._drawn = {}


def _make_camera(road: Road, options: PictureOptions) -> "Camera":
    from simulator.camera import Camera, Light  # the renderer only where images are

    light = Light.named(options.light, np.random.default_rng([options.light_seed, 2]))
    return Camera(road, options.camera, seed=options.light_seed, light=light)
