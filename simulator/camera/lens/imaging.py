"""Turns the rendered picture into the recorded picture: rain drops, blur, noise, tone and JPEG."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.bridges.bridges import HEADROOM_M, Bridge
from simulator.camera.core import optics
from simulator.camera.core.optics import Eye
from simulator.camera.lens.cabin import REFERENCE_WIDTH, glass_of
from simulator.camera.lens.develop import develop, noise_table
from simulator.camera.lens.drops import Windscreen
from simulator.camera.scene.light import Light
from simulator.varied.look import RoadLook
from trackfeatures.camera import CameraParameters

Picture = NDArray[np.uint8]

RAIN_DROPS = 0.08
"""Share of the windscreen that drops cover between two strokes of the wiper in rain, for looks
without drops of their own."""
DAZZLED = 245
"""Display value (0 to 255) from which a pixel is taken as a part of the visible sun."""
GLOWS = np.uint8(215)
"""Display value (0 to 255) from which a pixel glows at night."""
GLOW_GAIN = 12.0
ADAPTING_M = 10.0
"""Distance driven while the exposure adapts to a change of brightness by 63 %."""
DARK_NOISE = 1.8
"""Factor on the sensor noise at night."""


class Imaging:
    """Applies the effects of cabin, lens and sensor to the pictures of one camera. `look` gives the
    effects, `light` the light of the scene, `bridges` the places where the exposure adapts, on a
    lap of `lap_m` (m)."""

    def __init__(
        self,
        look: RoadLook,
        light: Light,
        camera: CameraParameters,
        bridges: Sequence[Bridge],
        lap_m: float,
    ) -> None:
        width, height = camera.width, camera.height
        self._lens, self._light, self._flare = look.lens, light, look.light.flare
        self._size = width, height
        self._matrix: FloatArray = camera.intrinsics()
        self._motion = _motion_of(camera, look.lens.travel_m)
        self._glass = glass_of(look, light, width, height)
        adapts = 0.0 if look.light.night else look.light.adaptation_stops
        self._adaptation = adapts, [_deck(bridge) for bridge in bridges], lap_m
        self._night = look.light.night
        self._normal = noise_table()
        self._noise = look.lens.noise * (DARK_NOISE if look.light.night else 1.0)
        self._windscreen: Windscreen | None = None
        wet = look.cabin.drops or (RAIN_DROPS if light.weather == "rain" else 0.0)
        if wet > 0.0:
            self._windscreen = Windscreen(
                look.cabin, wet, wipes=look.cabin.wipers or light.weather == "rain", size=self._size
            )

    def developed(self, picture: Picture, eye: Eye, s: float) -> Picture:
        """Turn the rendered `picture` (H, W, 3) of `eye`, at `s` m along the road, into the
        recorded picture (H, W, 3)."""
        lens = self._lens
        if self._night:
            picture = _with_glow(picture)
        if self._windscreen is not None:
            picture = self._windscreen.applied(picture, s)
        if lens.softness_px > 0.0:
            blur = lens.softness_px * self._size[0] / REFERENCE_WIDTH
            picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), blur), np.uint8)
        picture = develop(
            picture,
            self._glass.gain,
            self._glass.add,
            2.0 ** adaptation(s, *self._adaptation),
            self._motion,
            self._glare(picture, eye),
            (self._noise, _seed_of(eye)),
            self._normal,
            lens.contrast,
        )
        if lens.sharpening > 0.0:
            soft = cv2.GaussianBlur(picture, (3, 3), 0.0)
            mixed = cv2.addWeighted(picture, 1.0 + lens.sharpening, soft, -lens.sharpening, 0.0)
            picture = np.asarray(mixed, np.uint8)
        return _compressed(picture, lens.jpeg_quality) if lens.jpeg_quality else picture

    def _glare(self, picture: Picture, eye: Eye) -> tuple[float, float, float]:
        """Return position (u, v) px of the sun and strength of its glare for `develop`."""
        right, up, ahead = eye.axes @ np.array(self._light.sun_direction)
        if self._flare == 0.0 or ahead < 0.05 or self._light.shade > 0.5:
            return 0.0, 0.0, 0.0
        u = float(self._matrix[0, 2] + self._matrix[0, 0] * right / ahead)
        v = float(self._matrix[1, 2] - self._matrix[1, 1] * up / ahead)
        width, height = self._size
        beyond = max(-u, u - width, -v, v - height, 0.0)
        strength = self._flare * float(np.exp(-beyond / (0.2 * width)))
        if beyond == 0.0:
            part = picture[max(int(v) - 2, 0) : int(v) + 3, max(int(u) - 2, 0) : int(u) + 3]
            strength *= (
                0.1 + 0.9 * float((part.min(axis=2) >= DAZZLED).mean()) if part.size else 1.0
            )
        return u, v, strength


def _motion_of(camera: CameraParameters, travel_m: float) -> tuple[float, float, float, float]:
    """Return `develop`'s argument `motion` for a car that drives `travel_m` (m) during the
    exposure."""
    matrix = camera.intrinsics()
    ahead = optics.extrinsics(camera, np.zeros(6), "front")[:3, 0]
    u, v, _ = matrix @ ahead / ahead[2]
    return float(u), float(v), float(camera.height_above_road_m * matrix[1, 1]), travel_m


def adaptation(s: float, stops: float, decks: Sequence[tuple[float, float]], lap_m: float) -> float:
    """Return the number of stops by which the exposure is increased at `s` (m) along the road, also
    by a bridge before the start line. Below a bridge it rises to at most `stops`, behind the bridge
    it falls to 0. `decks` contains the position along the road and half the length of each deck
    (m); `lap_m` is the length of the lap (m)."""
    most = 0.0
    for place, half in decks:
        driven = (s - (place - half)) % lap_m
        into, behind = min(driven, 2.0 * half), max(driven - 2.0 * half, 0.0)
        opened = 1.0 - math.exp(-into / ADAPTING_M)
        most = max(most, opened * math.exp(-behind / ADAPTING_M))
    return stops * most


def _deck(bridge: Bridge) -> tuple[float, float]:
    """Return position along the road and half length (m) of the part of `bridge` over the road."""
    over = bridge.boxes[bridge.boxes[:, 0, 2] > HEADROOM_M]
    return bridge.s, float(np.abs(over[..., 0]).max()) if len(over) else bridge.half_along


def _with_glow(picture: Picture) -> Picture:
    """Return the picture with a glow round the pixels brighter than `GLOWS`."""
    width, height = picture.shape[1], picture.shape[0]
    bright = np.maximum(picture, GLOWS) - GLOWS
    small = cv2.resize(bright, (width // 4, height // 4), interpolation=cv2.INTER_AREA)
    glow = cv2.GaussianBlur(small, (0, 0), 0.007 * width)
    return np.asarray(
        cv2.addWeighted(picture, 1.0, cv2.resize(glow, (width, height)), GLOW_GAIN, 0.0), np.uint8
    )


def _seed_of(eye: Eye) -> int:
    """Return the seed of a picture's noise, a hash of the camera's position (there is no clock)."""
    x, y, z = (round(float(part) * 1e4) for part in eye.place)
    return ((x * 73_856_093) ^ (y * 19_349_663) ^ (z * 83_492_791)) % 2**62


def _compressed(picture: Picture, quality: int) -> Picture:
    """Return the picture after JPEG compression of `quality` (1 to 100) with 4:2:0 chroma
    subsampling."""
    bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise RuntimeError(f"cv2 did not encode a picture of {picture.shape} as JPEG")
    read = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))
    return np.asarray(cv2.cvtColor(read, cv2.COLOR_BGR2RGB), np.uint8)
