"""Rain and snow: brightness and contrast of each kind, deterministic drops, visible markings."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.camera import KINDS, Camera, Light
from simulator.camera.scene.light import WEATHERS
from simulator.camera.snapshot import standing_pose
from simulator.track.catalogue import find_track
from simulator.track.markings import MarkingStyle
from simulator.track.road import Road

FloatArray = NDArray[np.float64]

SEEDS = (1, 2)
PLACES = (40.0, 730.0)


@cache
def road() -> Road:
    return Road(replace(find_track("countryside"), markings=MarkingStyle()), 2)


@cache
def bare_road() -> Road:
    return Road(replace(road().track, markings=MarkingStyle(line_width=1e-6)), 2)


def light(kind: str, seed: int = 1) -> Light:
    return replace(Light.named(kind, np.random.default_rng(seed)), exposure=1.0)


@cache
def pictures(kind: str) -> FloatArray:
    """Pictures (seeds * places, 210, 280, 3) in linear light, 0 to 1."""
    taken = []
    for seed in SEEDS:
        with Camera(road(), seed=5, light=light(kind, seed)) as camera:
            taken += [camera.render(standing_pose(road(), s, 0.4)) for s in PLACES]
    return np.square(np.array(taken) / 255.0)


def ground(kind: str) -> FloatArray:
    return pictures(kind)[:, 130:]


def saturation(part: FloatArray) -> float:
    return float(np.mean(part.max(axis=-1) - part.min(axis=-1)) / np.mean(part))


def detail_far_away(kind: str) -> float:
    """Contrast of objects 60 m away and more, just above the horizon, without drops."""
    found = []
    for seed in SEEDS:
        still = replace(light(kind, seed), falling=0.0)
        with Camera(road(), seed=5, light=still) as camera:
            for s in PLACES:
                strip = camera.render(standing_pose(road(), s, 0.4))[96:108].astype(np.float64)
                found.append(strip.mean(axis=2).std(axis=1).mean())
    return float(np.mean(found))


def test_light_kinds_are_the_documented_ones() -> None:
    assert KINDS == ("clear", "overcast", "dusk", "fog", "heavy-shadow", "rain", "snow")
    assert WEATHERS == ("rain", "snow")
    for kind in KINDS:
        assert light(kind).weather == (kind if kind in WEATHERS else "")


def test_snow_is_white_and_rain_is_dark_and_grey() -> None:
    assert ground("snow").mean() > 1.8 * ground("overcast").mean()
    asphalt = {kind: pictures(kind)[:, 180:, 110:170].mean() for kind in ("overcast", "rain")}
    assert asphalt["rain"] < 0.75 * asphalt["overcast"]
    sky = {kind: pictures(kind)[:, :60] for kind in KINDS}
    assert saturation(sky["rain"]) < 0.3 * saturation(sky["clear"])
    assert saturation(sky["snow"]) < 0.3 * saturation(sky["clear"])
    assert sky["rain"].mean() < 0.7 * sky["overcast"].mean()
    # Wheel tracks are dark in the snow: the road has more contrast than a dry one.
    assert ground("snow").std() > 1.5 * ground("overcast").std()


def test_rain_and_snow_reduce_visibility_less_than_fog() -> None:
    seen = {kind: detail_far_away(kind) for kind in ("clear", "rain", "snow", "fog")}
    assert seen["fog"] < seen["rain"] < 0.8 * seen["clear"]
    assert seen["snow"] < 0.8 * seen["clear"]
    for kind in WEATHERS:
        reach = [light(kind, seed).haze_per_km for seed in range(40)]
        assert max(light("clear", seed).haze_per_km for seed in range(40)) < min(reach)
        assert max(reach) < 10.0


def test_a_wet_road_reflects_the_sky_at_grazing_angles() -> None:
    """The far road, at a grazing angle, is nearly as bright as the sky; the near road is dark."""
    for kind, low, high in (("rain", 1.7, 9.0), ("overcast", 0.7, 1.6)):
        clear_air = replace(light(kind), haze_per_km=0.1, falling=0.0)
        with Camera(bare_road(), seed=5, light=clear_air) as camera:
            shots = [camera.render(standing_pose(road(), s, 2.0)) for s in PLACES]
        values = np.square(np.array(shots) / 255.0)
        far, near = values[:, 116:122, 130:150].mean(), values[:, 190:, 100:180].mean()
        assert low < far / near < high, kind


@pytest.mark.parametrize("kind", WEATHERS)
def test_drops_depend_only_on_pose_and_seed(kind: str) -> None:
    pose = standing_pose(road(), 120.0, 0.0)
    beside = pose + np.array([0.002, 0.0, 0.0, 0.0, 0.0, 0.0])

    def drops(camera: Camera, still: Camera, at: FloatArray) -> NDArray[np.bool_]:
        apart = camera.render(at).astype(int) - still.render(at).astype(int)
        return np.asarray(np.abs(apart).sum(axis=2) > 20)

    falling = light(kind, 4)
    with (
        Camera(road(), seed=3, light=falling) as camera,
        Camera(road(), seed=3, light=falling) as again,
        Camera(road(), seed=9, light=falling) as other,
        Camera(road(), seed=3, light=replace(falling, falling=0.0)) as still,
        Camera(road(), seed=9, light=replace(falling, falling=0.0)) as other_still,
    ):
        first = camera.render(pose)
        camera.render(beside)
        camera.render(pose, view="rear")
        assert np.array_equal(camera.render(pose), first)
        assert np.array_equal(again.render(pose), first)
        here = drops(camera, still, pose)
        assert 0.002 < here.mean() < 0.2
        for moved in (drops(camera, still, beside), drops(other, other_still, pose)):
            assert (here & moved).sum() < 0.5 * here.sum()


@pytest.mark.parametrize("kind", WEATHERS)
def test_random_parameters_of_a_kind_depend_on_the_seed(kind: str) -> None:
    drawn = [Light.named(kind, np.random.default_rng(seed)) for seed in range(30)]
    assert drawn[7] == Light.named(kind, np.random.default_rng(7))
    for name in ("sun_azimuth", "sun_elevation", "haze_per_km", "cover", "falling", "exposure"):
        values = [getattr(each, name) for each in drawn]
        assert np.ptp(values) > 0.25 * abs(np.mean(values)), name
    assert all(0.0 < each.cover <= 1.0 and 0.0 < each.falling <= 1.0 for each in drawn)


@pytest.mark.parametrize(
    ("kind", "azimuth", "sun_green", "horizon_red", "haze_per_km", "exposure"),
    [
        ("clear", 0.096293340, 1.986553341, 0.669518271, 0.967596382, 0.997769856),
        ("overcast", 1.934849046, 0.165080164, 0.610820313, 2.326051934, 1.116449915),
        ("dusk", 1.934849046, 0.807840842, 0.951831927, 1.813077245, 0.997769856),
        ("fog", -2.802736057, 0.05, 0.633660605, 7.438819397, 1.173201524),
        ("heavy-shadow", 0.096293340, 2.15, 0.669518271, 0.967596382, 1.129176240),
        ("rain", -0.732814935, 0.039282548, 0.460827051, 6.847644738, 0.997769856),
        ("snow", -0.732814935, 0.094540082, 0.567762088, 8.155585528, 1.116449915),
    ],
)
def test_a_seed_always_draws_the_same_light(
    kind: str,
    azimuth: float,
    sun_green: float,
    horizon_red: float,
    haze_per_km: float,
    exposure: float,
) -> None:
    """Values are drawn in the order of light.toml, so another order would change the images."""
    drawn = Light.named(kind, np.random.default_rng(5))
    found = (drawn.sun_azimuth, drawn.sun[1], drawn.horizon[0], drawn.haze_per_km, drawn.exposure)
    assert found == pytest.approx(
        (azimuth, sun_green, horizon_red, haze_per_km, exposure), rel=1e-7
    )


def marking_contrast(kind: str, seed: int) -> float:
    """Mean light of the outer lines, 4 to 25 m ahead, over that of the road beside them."""
    ratios = []
    with Camera(road(), seed=5, light=light(kind, seed)) as camera:
        for s in PLACES:
            pose = standing_pose(road(), s, 0.0)
            grey = np.square(camera.render(pose) / 255.0).mean(axis=2)
            for y in (-4.0, 4.0):
                line, beside = (
                    _along(camera, grey, pose, s, y + shift) for shift in (0.0, -np.sign(y) * 0.5)
                )
                ratios.append(line.mean() / beside.mean())
    return float(np.median(ratios))


def _along(camera: Camera, grey: FloatArray, pose: FloatArray, s: float, y: float) -> FloatArray:
    place = road().track.at(s + np.arange(4.0, 25.0, 0.25), y)
    pixels, _ = camera.project(np.stack([place.x, place.y, place.z], axis=1), pose)
    u, v = np.rint(pixels).astype(int).T
    shown = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return np.asarray(grey[v[shown], u[shown]])


def test_markings_stay_visible_in_rain() -> None:
    dry = np.mean([marking_contrast("overcast", seed) for seed in SEEDS])
    wet = [marking_contrast("rain", seed) for seed in SEEDS]
    assert dry > 2.5
    assert min(wet) > 1.5


def test_dry_lights_use_shaders_without_weather() -> None:
    """Dry lights use shader programs compiled without the weather code."""
    from simulator.camera.core.context import WEATHER_PROGRAMS, graphics

    shared = graphics()
    with shared.turns:
        for name in WEATHER_PROGRAMS:
            assert shared.weather_program(name, "") == name
            for kind in WEATHERS:
                variant = shared.weather_program(name, kind)
                assert variant != name
                assert shared.programs[variant] is not shared.programs[name]
    assert light("clear").falling == 0.0
