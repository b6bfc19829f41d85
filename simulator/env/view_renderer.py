"""Renders the views of an environment, each at most once per step, with one camera that is built at
first use."""

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from simulator.bounds import check_whole
from simulator.track.road import Road
from simulator.vehicle.state import CarState
from simulator.world.world import World
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from simulator.camera import Camera


@dataclass(frozen=True)
class RenderOptions:
    """Options for rendering the views. The random values of scenery and light depend only on
    `light_seed`, so they are equal in all episodes on the same road."""

    width: int = 280
    height: int = 210
    light: str = "clear"
    """Kind of light and weather, one of `simulator.camera.KINDS`."""

    light_seed: int = 0
    mount: CameraParameters | None = None
    """Position, angles and lens of the driver camera; its image size is set to `width` x `height`.
    None: the default camera."""

    render_view: str = "front"
    """Name of the view that `render()` returns, in colour."""

    def __post_init__(self) -> None:
        from simulator.camera import VIEWS, check_light, check_size

        check_size(check_whole("width", self.width), check_whole("height", self.height))
        check_whole("light_seed", self.light_seed)
        check_light(self.light)
        if self.render_view not in VIEWS:
            raise UserError(
                f"render_view is {self.render_view!r}; the views are {', '.join(VIEWS)}"
            )

        if self.mount is not None and not isinstance(self.mount, CameraParameters):
            raise UserError(f"mount is {self.mount!r}; give a CameraParameters, or None")

    @property
    def camera(self) -> CameraParameters:
        mount = self.mount or CameraParameters()
        if mount.matrix is not None:
            return mount.resized(self.width, self.height)
        return replace(mount, width=self.width, height=self.height)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (height, width, 3) of a colour image."""
        return self.height, self.width, 3

    def space(self, view: str) -> gym.spaces.Box:
        """Return the observation space of `view`. Raises UserError for an unknown view."""
        from simulator.camera.core.optics import FAR_M
        from simulator.camera.core.render_modes import CLASS, CLASSES, DEPTH, ViewRequest

        size = (self.height, self.width)
        kind = ViewRequest.of(view).kind
        if kind == DEPTH:
            return gym.spaces.Box(0.0, FAR_M, size, np.float32)
        if kind == CLASS:
            return gym.spaces.Box(0, len(CLASSES) - 1, size, np.uint8)
        return gym.spaces.Box(0, 255, self.shape, np.uint8)


class ViewRenderer:
    """Renders views of a world by name, each at most once per state."""

    def __init__(self, road: Road, options: RenderOptions) -> None:
        self._road, self.options = road, options
        self._camera: Camera | None = None
        self._rendered_state: CarState | None = None
        self._images: dict[str, NDArray[Any]] = {}

    def change_road(self, road: Road) -> None:
        """Render views of `road` from now on."""
        if road is not self._road:
            self.close()
            self._road = road

    def render(self, world: World, views: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Return copies of the views of the current state, in the order of `views`.

        They are the images of `Camera.render_views`, except that the depth of the sky is FAR_M
        (6000 m), the bound of the observation space.
        """
        if world.state is not self._rendered_state:
            self._rendered_state, self._images = world.state, {}
        missing = [view for view in views if view not in self._images]
        if missing:
            self._images |= self._render_missing(world, missing)
        return {view: self._images[view].copy() for view in views}

    def _render_missing(self, world: World, views: Sequence[str]) -> dict[str, NDArray[Any]]:
        from simulator.camera.core.render_modes import bounded

        images = self.camera.render_views(
            world.body_pose(), world.traffic.poses(), views, near_s=world.state.s
        )
        return {view: bounded(image) for view, image in images.items()}

    def calibration(self, views: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """Return `intrinsics` (3, 3) in pixels and, by view name, the extrinsics (4, 4) from body
        to camera frame; see `Camera.extrinsics`. Nothing is drawn."""
        from simulator.camera.core.optics import extrinsics
        from simulator.camera.core.render_modes import ViewRequest

        camera = self.options.camera
        at_rest = np.zeros(6)
        by_view = {view: extrinsics(camera, at_rest, ViewRequest.of(view).view) for view in views}
        return {"intrinsics": camera.intrinsics()} | by_view

    @property
    def camera(self) -> "Camera":
        """The camera. It is built at first use, because building the scenery takes seconds."""
        if self._camera is None:
            from simulator.camera import open_camera  # loads the renderer only when it is needed

            options = self.options
            self._camera = open_camera(
                self._road, options.camera, light=options.light, seed=options.light_seed
            )
            # Frees the graphics memory of an environment that is dropped without close().
            self._finaliser = weakref.finalize(self, self._camera.close)
            self._finaliser.atexit = False
        return self._camera

    def close(self) -> None:
        """Free the graphics memory; the next `render` builds a new camera."""
        if self._camera is not None:
            self._finaliser()  # closes the camera, and no longer refers to it
            self._camera = None
        self._images = {}
