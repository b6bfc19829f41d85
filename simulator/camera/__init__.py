"""Pictures of the simulated road: the camera, its light and its mounts."""

from simulator.camera.camera import Camera
from simulator.camera.light import KINDS, Light, check_light
from simulator.camera.optics import VIEWS, Mount

__all__ = ["KINDS", "VIEWS", "Camera", "Light", "Mount", "check_light"]
