"""Bonnet, vignette, dirt, reflections and drops; adaptation under bridges; low sun and night."""

from dataclasses import replace

import numpy as np
import pytest

from simulator.camera.core import optics
from simulator.camera.lens.cabin import bonnet_edge, glass_of, vignette
from simulator.camera.lens.drops import Windscreen
from simulator.camera.lens.imaging import ADAPTING_M, Imaging, adaptation
from simulator.camera.scene.light import Light
from simulator.camera.scene.varied_light import lit_as
from simulator.varied.look import Cabin, Lens, Lighting, RoadLook
from trackfeatures.camera import CameraParameters

WIDTH, HEIGHT = 280, 210
LIGHT = Light.named("clear", np.random.default_rng(1))


@pytest.mark.parametrize("share", [0.05, 0.15, 0.25])
@pytest.mark.parametrize("shape", range(6))
def test_a_bonnet_covers_its_share_of_the_rows(share: float, shape: int) -> None:
    edge = bonnet_edge(Cabin(bonnet=share, shape=shape), WIDTH, HEIGHT)
    assert abs(edge.max() - share * HEIGHT) < 1e-9
    assert edge.min() >= 0.0
    glass = glass_of(RoadLook(cabin=Cabin(bonnet=share, shape=shape)), LIGHT, WIDTH, HEIGHT)
    covered = np.flatnonzero((glass.gain[..., 1] < 0.5).any(axis=1))
    assert covered.max() == HEIGHT - 1
    assert abs((HEIGHT - covered.min()) - share * HEIGHT) <= 3.0


def test_shapes_differ() -> None:
    edges = [bonnet_edge(Cabin(bonnet=0.2, shape=shape), WIDTH, HEIGHT) for shape in range(8)]
    assert min(np.abs(a - b).max() for k, a in enumerate(edges) for b in edges[:k]) > 1.0


def test_a_clean_cabin_changes_nothing() -> None:
    glass = glass_of(RoadLook(), LIGHT, WIDTH, HEIGHT)
    assert (glass.gain == 1.0).all()
    assert (glass.add == 0.0).all()


def test_the_corners_lose_the_declared_light() -> None:
    kept = vignette(0.4, WIDTH, HEIGHT)
    assert abs(kept[0, 0] - 0.6) < 1e-9
    assert abs(kept[-1, -1] - 0.6) < 1e-9
    assert kept[HEIGHT // 2, WIDTH // 2] > 0.9999


def test_dirt_and_reflections_take_light_and_add_a_veil() -> None:
    for cabin in (Cabin(dirt=1.0, shape=3), Cabin(reflection=0.25, shape=3)):
        glass = glass_of(RoadLook(cabin=cabin), LIGHT, WIDTH, HEIGHT)
        assert 0.3 < glass.gain.min() < 0.99
        assert glass.add.min() >= 0.0
        assert glass.add.max() > 0.02


def test_drops_cover_their_share_and_the_wiper_comes_back() -> None:
    picture = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    still = Windscreen(Cabin(shape=4), 0.1, wipes=False, size=(WIDTH, HEIGHT))
    found = still.applied(picture, 10.0)
    assert np.array_equal(found, still.applied(picture, 500.0))
    assert 0.05 < np.mean((found != picture).any(axis=2)) < 0.13
    wiped = Windscreen(Cabin(shape=4), 0.1, wipes=True, size=(WIDTH, HEIGHT))
    dark = [np.mean(wiped.applied(picture, 1.0 * k).max(axis=2) < 40) for k in range(60)]
    assert max(dark) > 3.0 * min(dark) + 0.005


def test_exposure_opens_under_a_bridge_and_closes_behind_it() -> None:
    bridge = [(100.0, 6.0)]
    assert adaptation(90.0, 1.5, bridge, 3000.0) < 1e-9
    opened = [1.5 * (1.0 - np.exp(-way / ADAPTING_M)) for way in (6.0, 12.0)]
    assert abs(adaptation(100.0, 1.5, bridge, 3000.0) - opened[0]) < 1e-9
    assert abs(adaptation(106.0, 1.5, bridge, 3000.0) - opened[1]) < 1e-9
    assert abs(adaptation(106.0 + ADAPTING_M, 1.5, bridge, 3000.0) - opened[1] / np.e) < 1e-9


def test_exposure_does_not_jump_at_the_start_line() -> None:
    bridge = [(2997.0, 6.0)]
    before, after = (adaptation(s, 1.5, bridge, 3000.0) for s in (3000.0 - 1e-6, 0.0))
    assert before > 0.5
    assert abs(after - before) < 1e-3


def test_exposure_stops_night_and_a_low_sun_change_the_light() -> None:
    brighter = lit_as(LIGHT, Lighting(exposure_stops=1.0))
    assert brighter == replace(LIGHT, exposure=2.0 * LIGHT.exposure)
    low = lit_as(LIGHT, Lighting(low_sun_deg=6.0))
    assert abs(low.sun_elevation - np.radians(6.0)) < 1e-12
    assert low.sun[2] / low.sun[0] < LIGHT.sun[2] / LIGHT.sun[0]
    assert lit_as(Light.named("fog", np.random.default_rng(1)), Lighting(low_sun_deg=6.0)).kind
    night, lit = (lit_as(LIGHT, Lighting(night=True, lamp_every_m=e)) for e in (0.0, 30.0))
    assert max(night.sky) < 0.05 * min(LIGHT.sky)
    assert max(night.sky) < min(lit.sky) < 0.2 * min(LIGHT.sky)


def test_a_picture_is_a_function_of_its_place() -> None:
    look = RoadLook(lens=Lens(noise=3.0, travel_m=0.1, jpeg_quality=40, sharpening=0.5))
    camera = CameraParameters()
    picture = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    imaging = Imaging(look, LIGHT, camera, (), 3000.0)
    here, there = (optics.eye_of(camera, (x, 0, 0, 0, 0, 0), "front") for x in (1.0, 1.5))
    first = imaging.developed(picture, here, 1.0)
    imaging.developed(picture, there, 1.5)
    again = Imaging(look, LIGHT, camera, (), 3000.0).developed(picture, here, 1.0)
    assert np.array_equal(first, again)
    assert np.mean(first != imaging.developed(picture, there, 1.0)) > 0.3
