"""Rendered looks of varied roads: the effect of each look, and what no look changes."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.camera import Camera, Light
from simulator.camera.scene.roadside import DRIVEN_M, NearRoad, parked_cars, seen_road
from simulator.camera.snapshot import standing_pose
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.varied.carriageway import Carriageway
from simulator.varied.look import Lens, Lighting, RoadLook, Roadside, Surface

LIGHT = Light.named("clear", np.random.default_rng(1))
OVERCAST = Light.named("overcast", np.random.default_rng(1))


@pytest.fixture(scope="module")
def road() -> Road:
    return Road.varied(find_track("town"), Carriageway.drawn(4, 2))


@pytest.fixture(scope="module")
def camera(road: Road) -> Camera:
    return Camera(road, seed=3, light=OVERCAST, look=RoadLook(), scenes=1)


@pytest.fixture(scope="module")
def plain(camera: Camera) -> NDArray[np.float64]:
    """The view of a road of one plain tone."""
    return view(camera, RoadLook(surface=Surface(tone=0.12)))


def view(camera: Camera, look: RoadLook, light: Light = OVERCAST) -> NDArray[np.float64]:
    """Linear light (H, W, 3) of the driver view."""
    camera.change_scene(3, light, look)
    picture = camera.render(standing_pose(camera.road, 300.0, 0.0))
    return (picture.astype(np.float64) / 255.0) ** 2


def road_pixels(camera: Camera) -> NDArray[np.bool_]:
    pose = standing_pose(camera.road, 300.0, 0.0)
    return np.asarray(camera.render_views(pose, views=["front:class"])["front:class"] == 0)


def test_a_stop_more_doubles_the_light(camera: Camera) -> None:
    dark = view(camera, RoadLook(light=Lighting(exposure_stops=-1.5)))
    usual = view(camera, RoadLook(light=Lighting(exposure_stops=-0.5)))
    clear = usual.max(axis=2) < 0.95
    assert clear.mean() > 0.9
    assert abs(usual[clear].mean() / dark[clear].mean() - 2.0) < 0.03


def test_the_road_has_the_declared_tone(camera: Camera) -> None:
    tones = []
    for tone in (0.07, 0.28):
        surface = Surface(tone=tone, grain=0.3)
        # The automatic exposure compensates part of the tone.
        stops = 0.45 * np.log2(tone / 0.13)
        look = RoadLook(surface=surface, light=Lighting(exposure_stops=float(stops) - 0.5))
        picture = view(camera, look)
        tones.append(picture[road_pixels(camera)].mean())
    assert abs(tones[1] / tones[0] - 4.0) < 0.5


@pytest.mark.parametrize(
    "surface",
    [
        Surface(tone=0.12, tar=1.0, seam_m=1.0),
        Surface(tone=0.12, patches=0.3, patch_tone=0.5),
        Surface(tone=0.12, concrete=1.0, joint_m=5.0),
        Surface(tone=0.12, halves=0.3, seam_m=0.5),
        Surface(tone=0.12, puddles=0.3),
    ],
    ids=["tar", "patches", "concrete", "halves", "puddles"],
)
def test_a_surface_changes_the_road_alone(
    camera: Camera, plain: NDArray[np.float64], surface: Surface
) -> None:
    other = view(camera, RoadLook(surface=surface))
    changed = np.abs(other - plain).max(axis=2) > 0.004
    on_road = road_pixels(camera)
    assert changed[on_road].mean() > 0.01
    assert changed[:100].mean() < 0.01


def test_looks_do_not_change_classes_and_depths(camera: Camera) -> None:
    pose = standing_pose(camera.road, 300.0, 0.0)
    names = ["front:class", "front:depth"]
    camera.change_scene(3, OVERCAST, RoadLook())
    plain = camera.render_views(pose, views=names)
    drawn = RoadLook.drawn(8)
    camera.change_scene(3, OVERCAST, replace(drawn, roadside=Roadside(), paint=RoadLook().paint))
    other = camera.render_views(pose, views=names)
    for name in names:
        assert np.array_equal(plain[name], other[name])


def test_the_same_look_twice_is_the_same_picture(camera: Camera) -> None:
    look = replace(RoadLook.drawn(5), lens=Lens(noise=4.0, travel_m=0.1, jpeg_quality=50))
    first = view(camera, look)
    view(camera, RoadLook())
    assert np.array_equal(first, view(camera, look))


def test_by_night_headlights_light_the_road_before_the_car(camera: Camera) -> None:
    picture = view(camera, RoadLook(light=Lighting(night=True)), LIGHT).mean(axis=2)
    assert picture[:80].mean() < 0.01
    near, beside = picture[150:190, 110:170].mean(), picture[170:, :15].mean()
    assert near > 0.02
    assert near > 3.0 * beside
    brighter = view(camera, RoadLook(light=Lighting(night=True, headlights=2.0)), LIGHT)
    assert brighter.mean(axis=2)[150:190, 110:170].mean() > 1.5 * near


def test_lamps_light_the_whole_road(camera: Camera) -> None:
    dark = view(camera, RoadLook(light=Lighting(night=True)), LIGHT).mean(axis=2)
    lit = view(camera, RoadLook(light=Lighting(night=True, lamp_every_m=30.0)), LIGHT).mean(axis=2)
    assert lit[170:, :15].mean() > 2.0 * dark[170:, :15].mean()


def test_it_is_darker_below_a_bridge_under_an_overcast_sky(camera: Camera) -> None:
    look = RoadLook(roadside=Roadside(bridge_every_m=200.0))
    camera.change_scene(3, OVERCAST, look)
    scene = camera._loaded.scene
    assert scene.mask.texels.shape[2] == 2
    bridge = scene.bridges[0]
    seen = []
    for s in (bridge.s - 2.0, bridge.s + 40.0):
        picture = camera.render(standing_pose(camera.road, s, 0.0)).astype(np.float64)
        seen.append(((picture[175:] / 255.0) ** 2).mean())
    assert 0.2 < seen[0] / seen[1] < 0.75


def test_barriers_come_near_but_leave_room_to_drive(road: Road) -> None:
    near = seen_road(road, RoadLook(roadside=Roadside(gap_m=0.2)))
    assert isinstance(near, NearRoad)
    markings = road.lanes * road.lane_width / 2
    assert near.wall_offset == max(road.half_asphalt + 0.2, markings + DRIVEN_M)
    assert seen_road(road, RoadLook()) is road
    assert seen_road(road, RoadLook(roadside=Roadside(gap_m=100.0))).wall_offset == road.wall_offset


def test_cars_park_beside_the_lanes(road: Road) -> None:
    parked = parked_cars(road, 20.0, np.random.default_rng(0))
    assert len(parked) > 100
    for x, y, *_ in parked[::7]:
        _, to_middle = road.track.project(float(x), float(y))
        assert abs(to_middle) > road.lanes * road.lane_width / 2 + 0.9
