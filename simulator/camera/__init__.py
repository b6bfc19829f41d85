"""The renderer, which draws camera images of the simulated road in different light and weather."""

from simulator.camera.core.camera import Camera, check_size, open_camera
from simulator.camera.core.optics import VIEWS
from simulator.camera.core.render_modes import CLASSES, PICTURE_KINDS
from simulator.camera.scene.light import KINDS, Light, check_light

__all__ = [
    "CLASSES",
    "KINDS",
    "PICTURE_KINDS",
    "VIEWS",
    "Camera",
    "Light",
    "check_light",
    "check_size",
    "open_camera",
]
