"""Effects of bonnet, windscreen dirt, reflections and vignette. They are constant in a scene, and
stored as a gain and an addition to the linear light of each pixel."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.scene.light import Light
from simulator.varied.look import Cabin, RoadLook

REFERENCE_WIDTH = 280.0
"""Picture width (px) for which blur radii and sizes in this package are stated."""
PAINTS = (
    (0.02, 0.02, 0.022), (0.34, 0.34, 0.33), (0.11, 0.115, 0.12), (0.16, 0.015, 0.012),
    (0.012, 0.03, 0.09), (0.09, 0.04, 0.03), (0.05, 0.052, 0.055), (0.02, 0.05, 0.035),
)  # fmt: skip
DASHBOARD = (0.012, 0.012, 0.013)


@dataclass(frozen=True)
class Glass:
    """Effects of the cabin: linear light (1 is the brightest displayed value) becomes light *
    `gain` + `add`; both are (H, W, 3)."""

    gain: NDArray[np.float32]
    add: NDArray[np.float32]


def glass_of(look: RoadLook, light: Light, width: int, height: int) -> Glass:
    """Compute the effects of cabin and lens of `look` in `light` on pictures of this size (px)."""
    cabin, lens = look.cabin, look.lens
    rng = np.random.default_rng([cabin.shape, 1])
    scene = surrounding_light(light, night=look.light.night)
    cover, bonnet = _bonnet(cabin, light, scene, width, height)
    dirt = cabin.dirt * _dirt(width, height, rng)
    mirrored = cabin.reflection * _reflections(width, height, rng)
    through = 1.0 - 0.55 * dirt - 0.3 * mirrored
    veil = (0.16 * dirt + mirrored)[..., None] * scene
    white = vignette(lens.vignette, width, height)[..., None] * np.array(
        [lens.red_gain, 1.0, lens.blue_gain]
    )
    gain = ((1.0 - cover) * through)[..., None] * white
    add = ((cover * through)[..., None] * bonnet + veil) * white
    return Glass(gain.astype(np.float32), add.astype(np.float32))


def surrounding_light(light: Light, night: bool) -> FloatArray:
    """Return the displayed light (3,), linear RGB, of a grey surface outdoors. At night the light
    of the sky is the only light."""
    sun = 0.0 if night else np.array(light.sun) * np.sin(light.sun_elevation)
    return np.asarray(0.5 * light.exposure * (np.array(light.sky) + sun))


def vignette(loss: float, width: int, height: int) -> FloatArray:
    """Return the share (H, W) of transmitted light: 1 in the middle, 1 - `loss` in the corners."""
    v, u = np.mgrid[0:height, 0:width]
    off = np.hypot(2.0 * u / (width - 1) - 1.0, (2.0 * v / (height - 1) - 1.0) * height / width)
    return np.asarray(1.0 - loss * (off / off.max()) ** 2.4)


def bonnet_edge(cabin: Cabin, width: int, height: int) -> FloatArray:
    """Return the number of picture rows (W,), counted from the bottom, that the bonnet covers in
    each column. Where the bonnet is highest, it covers the share `cabin.bonnet` of the picture's
    height."""
    rng = np.random.default_rng([cabin.shape, 2])
    x = (np.arange(width) + 0.5) / width * 2.0 - 1.0 - rng.normal(0.0, 0.15)
    drop = rng.uniform(0.05, 0.9) * np.abs(x) ** rng.uniform(1.6, 4.5)
    edge = 1.0 - drop + rng.normal(0.0, 0.08) * x
    if rng.uniform() < 0.4:  # a dome in the middle or two ridges
        ridge = rng.choice([0.0, rng.uniform(0.25, 0.6)])
        edge += rng.uniform(0.05, 0.2) * np.exp(-(((np.abs(x) - ridge) / 0.16) ** 2))
    edge = np.maximum(edge, 0.0)
    return np.asarray(edge / edge.max() * cabin.bonnet * height)


def _bonnet(
    cabin: Cabin, light: Light, scene: FloatArray, width: int, height: int
) -> tuple[FloatArray, FloatArray]:
    """Return the opacity (H, W) of the bonnet, 0 to 1, and its colour (H, W, 3) in linear light.
    `scene` (3,) is the result of `surrounding_light`."""
    if cabin.bonnet == 0.0:
        return np.zeros((height, width)), np.zeros((height, width, 3))
    edge = bonnet_edge(cabin, width, height)
    rng = np.random.default_rng([cabin.shape, 3])
    dashboard = rng.uniform() < 0.2
    paint = np.array(DASHBOARD if dashboard else PAINTS[rng.integers(len(PAINTS))])
    below = np.arange(height)[:, None] + 0.5 - (height - edge[None, :])
    cover = np.clip(below + 0.5, 0.0, 1.0)
    blur = rng.uniform(0.4, 2.0) * width / REFERENCE_WIDTH
    soft = cv2.GaussianBlur(cover, (0, 0), blur, borderType=cv2.BORDER_REPLICATE)
    share = np.clip(below / max(cabin.bonnet * height, 1.0), 0.0, 1.0)
    # At grazing angles the far end of the bonnet reflects the sky over the horizon.
    mirror = (0.0 if dashboard else rng.uniform(0.1, 0.45)) * np.exp(-share * rng.uniform(2.0, 7.0))
    streaks = cv2.GaussianBlur(rng.standard_normal((height, width)), (0, 0), 9.0, sigmaY=2.0)
    mirror = mirror * (1.0 + 1.5 * streaks / max(float(streaks.std()), 1e-9) * 0.2)
    sky = np.array(light.horizon) * light.exposure
    colour = paint * 1.6 * scene + np.maximum(mirror, 0.0)[..., None] * sky
    return np.asarray(soft, dtype=np.float64), np.asarray(colour, dtype=np.float64)


def _dirt(width: int, height: int, rng: np.random.Generator) -> FloatArray:
    """Return random dirt on the windscreen (H, W), 0 to 1: a film, smears of the wiper, specks."""
    scale = width / REFERENCE_WIDTH
    film = _field(width, height, 26.0 * scale, 18.0 * scale, rng)
    smear = _field(width, height, 9.0 * scale, 4.0 * scale, rng)
    speck = _field(width, height, 1.1 * scale, 1.1 * scale, rng)
    dirt = 0.35 * np.clip(0.4 + 0.5 * film, 0.0, 1.0) + 0.2 * np.clip(smear - 0.6, 0.0, 1.0)
    return np.asarray(np.clip(dirt + 0.6 * np.clip(1.6 * (speck - 2.3), 0.0, 1.0), 0.0, 1.0))


def _reflections(width: int, height: int, rng: np.random.Generator) -> FloatArray:
    """Return random reflections of the dashboard in the windscreen (H, W), 0 to 1."""
    layer = np.zeros((height, width), dtype=np.float32)
    for _ in range(rng.integers(2, 7)):
        middle = rng.uniform([-0.1, 0.35], [1.1, 1.1]) * (width, height)
        size = rng.uniform([0.05, 0.02], [0.5, 0.2]) * (width, height)
        lean = rng.uniform(-0.5, 0.5) * size[0]
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size / 2.0 + middle
        corners[:2, 0] += lean
        shape = np.zeros_like(layer)
        cv2.fillPoly(shape, [np.rint(corners).astype(np.int32)], float(rng.uniform(0.2, 1.0)))
        blur = float(np.exp(rng.uniform(np.log(0.8), np.log(9.0)))) * width / REFERENCE_WIDTH
        layer += cv2.GaussianBlur(shape, (0, 0), blur)
    rise = np.clip(np.linspace(-0.3, 1.0, height), 0.0, 1.0)[:, None]
    lit = 0.7 * layer + 0.45 * rng.uniform() * rise
    return np.asarray(np.clip(lit, 0.0, 1.0), dtype=np.float64)


def _field(
    width: int, height: int, sigma_u: float, sigma_v: float, rng: np.random.Generator
) -> FloatArray:
    """Return smooth noise (H, W) with standard deviation 1. `sigma_u` and `sigma_v` (px) are the
    standard deviations of the blur along a row and along a column."""
    noise = rng.standard_normal((height, width)).astype(np.float32)
    field = cv2.GaussianBlur(noise, (0, 0), sigma_u, sigmaY=sigma_v)
    return np.asarray(field / max(float(field.std()), 1e-9), dtype=np.float64)
