"""Pictures of the simulated road: the camera, its light and its mounts."""

from simulator.camera.camera import Camera, check_size
from simulator.camera.kinds import CLASSES, PICTURE_KINDS
from simulator.camera.light import KINDS, Light, check_light
from simulator.camera.optics import VIEWS, Mount, intrinsics

__all__ = [
    "CLASSES",
    "KINDS",
    "PICTURE_KINDS",
    "VIEWS",
    "Camera",
    "Light",
    "Mount",
    "check_light",
    "check_size",
    "intrinsics",
]
