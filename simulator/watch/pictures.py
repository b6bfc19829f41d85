"""Renders JPEG images of a watched world in any light; the scene is built at first use."""

from collections.abc import Sequence
from typing import Final

import simplejpeg

from simulator.camera import Camera, check_light, open_camera
from simulator.track.road import Road
from simulator.world.world import World
from trackfeatures.camera import CameraParameters

SIZE: Final = (560, 420)
"""Width and height in px: twice the width and height of the driver view."""
QUALITY: Final = 82


class JpegRenderer:
    """Renders worlds on one road as JPEG images. Only one thread may use it."""

    def __init__(self, road: Road, light: str, seed: int = 0) -> None:
        check_light(light)
        self.road, self.light = road, light
        self._seed = seed
        self._camera: Camera | None = None

    def set_light(self, light: str) -> None:
        """Set the light of later images. Raises UserError for an unknown light."""
        check_light(light)
        if light != self.light:
            self.light = light
            self.close()

    def open(self) -> Camera:
        """Return the camera, made at first use. Raises NoRendererError if nothing can render."""
        if self._camera is None:
            parameters = CameraParameters(*SIZE)
            self._camera = open_camera(self.road, parameters, light=self.light, seed=self._seed)
        return self._camera

    def render(self, world: World, views: Sequence[str]) -> dict[str, bytes]:
        """Return JPEGs of the current state of `world`, by view."""
        if not views:
            return {}
        images = self.open().render_views(world.body_pose(), world.traffic.poses(), views)
        return {
            view: bytes(simplejpeg.encode_jpeg(image, QUALITY, "RGB", "420"))
            for view, image in images.items()
        }

    def close(self) -> None:
        if self._camera is not None:
            self._camera.close()
            self._camera = None
