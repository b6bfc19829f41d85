"""Tree shadows in heavy-shadow light on every track; positions of bridges and their shadows."""

import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.camera import Camera, Light
from simulator.camera.bridges import bridges
from simulator.camera.bridges.bridges import CLEARANCE_M, Bridge
from simulator.camera.scene import shadow_mask
from simulator.camera.scene.road_mesh import Ground
from simulator.camera.scene.shadow_mask import cast_bridges
from simulator.camera.scene.terrain import CentreLineSamples, Survey
from simulator.camera.scene.terrain import build as build_terrain
from simulator.camera.scene.themes import find_theme, themes
from simulator.camera.snapshot import standing_pose
from simulator.track.catalogue import OWN_TRACKS, find_track
from simulator.track.road import Road
from simulator.track.toml_track import LOOKS as TRACK_LOOKS
from trackfeatures.camera import CameraParameters

FloatArray = NDArray[np.float64]

NAMES = sorted(path.stem for path in OWN_TRACKS.glob("*.toml"))


def light(kind: str, seed: int) -> Light:
    return Light.named(kind, np.random.default_rng(seed))


def bridges_of(road: Road, seed: int) -> tuple[Bridge, ...]:
    """The bridges that a scene of this seed has."""
    theme, survey = find_theme(road.track.look), Survey.of(road)
    terrain = build_terrain(road, survey, theme, np.random.default_rng([seed, 1]))
    ground = Ground.of(road, survey.line, terrain)
    return bridges.build(ground, theme, np.random.default_rng([seed, 8]))


def test_every_track_look_has_a_scenery_theme() -> None:
    assert set(TRACK_LOOKS) == set(themes())


@pytest.mark.parametrize("name", NAMES)
def test_heavy_shadow_covers_30_to_80_percent_of_every_road(name: str) -> None:
    for number in range(2):
        lanes = 1 + (len(name) + number) % 3
        road = Road(find_track(name), lanes)
        seed = 10 * number + len(name)
        shadows = light("heavy-shadow", seed)
        with Camera(road, CameraParameters(8, 8), seed=seed, light=shadows) as camera:
            mask = camera._loaded.scene.mask
        places = np.arange(0.0, road.track.length_m, 3.0)
        shares = [mask.fraction(float(s), road.half_asphalt) for s in places]
        assert min(shares) >= 0.3, (lanes, seed)
        assert max(shares) <= 0.8, (lanes, seed)
        assert np.std(shares) > 0.02


def lit_and_dark(camera: Camera, s: float) -> tuple[FloatArray, FloatArray]:
    """Linear light of road pixels 3 to 15 m ahead, in the sun and in shadow according to the mask;
    markings and shadow edges are left out."""
    road, mask = camera.road, camera._loaded.scene.mask
    pose = standing_pose(road, s, 0.0)
    grey = np.square(camera.render(pose) / 255.0).mean(axis=2)
    at_s, at_y = np.meshgrid(s + np.arange(3.0, 15.0, 0.1), np.arange(-3.4, -0.6, 0.1))
    place = road.track.at(at_s % road.track.length_m, at_y)
    pixels, _ = camera.project(np.stack([place.x, place.y, place.z], axis=-1).reshape(-1, 3), pose)
    u, v = np.floor(pixels).astype(int).T
    rows, columns = mask.strip.shape
    i = np.floor(at_y / shadow_mask.TEXEL_M + rows / 2).astype(int).ravel()
    j = np.floor(at_s / mask.along_m).astype(int).ravel() % columns
    around = np.array(
        [mask.strip[i + a, (j + b) % columns] for a in (-2, 0, 2) for b in (-2, 0, 2)]
    )
    shown = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    sunny, dark = shown & (around.max(axis=0) < 20), shown & (around.min(axis=0) > 235)
    return grey[v[sunny], u[sunny]], grey[v[dark], u[dark]]


@pytest.mark.parametrize("name", ["town", "oval", "gravel-valley"])
def test_luminance_in_shadow_is_at_most_two_fifths_of_lit(name: str) -> None:
    road = Road(find_track(name), 2)
    rng = np.random.default_rng(4)
    for seed in (1, 2):
        with Camera(road, seed=seed, light=light("heavy-shadow", seed)) as camera:
            found = [lit_and_dark(camera, s) for s in rng.uniform(0.0, road.track.length_m, 12)]
        sunny = np.concatenate([one for one, _ in found])
        dark = np.concatenate([other for _, other in found])
        assert min(len(sunny), len(dark)) > 300
        assert np.mean(dark) < 0.4 * np.mean(sunny)


def test_shadow_edges_are_about_one_texel_wide() -> None:
    """Few texels lie between light and shadow: edges are about one texel wide."""
    road = Road(find_track("forest"), 2)
    with Camera(road, seed=3, light=light("heavy-shadow", 3)) as camera:
        strip = camera._loaded.scene.mask.strip
    half = round(road.half_asphalt / shadow_mask.TEXEL_M)
    middle = strip.shape[0] // 2
    asphalt = strip[middle - half : middle + half]
    # road.frag.glsl draws the whole transition between mask values 0.3 and 0.7.
    between = np.mean((asphalt > 0.3 * 255) & (asphalt < 0.7 * 255))
    assert between < 0.06


@pytest.mark.parametrize("kind", ["clear", "heavy-shadow"])
def test_shadow_mask_fades_smoothly_at_its_rim(kind: str) -> None:
    """At its rim the mask has the terrain's smooth shade, without a step towards it."""
    road = Road(find_track("forest"), 2)
    with Camera(road, seed=3, light=light(kind, 3)) as camera:
        strip = camera._loaded.scene.mask.strip.astype(np.float64)
    assert strip.shape[0] * shadow_mask.TEXEL_M > 2 * (road.wall_offset + 10.0)
    for rows in (strip, strip[::-1]):
        assert rows[:4].std(axis=0).max() < 1.0
        means = (rows >= 128).mean(axis=1)
        wall = round(
            (strip.shape[0] * shadow_mask.TEXEL_M / 2 - road.wall_offset) / shadow_mask.TEXEL_M
        )
        assert np.abs(np.diff(means[: wall + 4])).max() < 0.15


@pytest.mark.parametrize("name", NAMES)
def test_bridges_leave_the_specified_clearance_over_the_road(name: str) -> None:
    """No part of a bridge is lower than 2.4 m between the wall lines, or lower than 3 m over the
    asphalt; the middle of a bridge has the clearance of CLEARANCE_M."""
    road = Road(find_track(name), 1 + len(name) % 3)
    line = CentreLineSamples.of(road)
    found = bridges_of(road, seed=2)
    assert len(found) >= 2
    for bridge in found:
        points = bridge.triangles[:, :3]
        near = line.distance(points[:, 0], points[:, 1])
        over = points[near < road.half_asphalt]
        edge = road.track.at(bridge.s, np.linspace(-road.half_asphalt, road.half_asphalt, 9))
        assert points[near < road.wall_offset, 2].min(initial=np.inf) > edge.z.min() + 2.4
        assert over[:, 2].min(initial=np.inf) > edge.z.max() + 3.0
        crown = bridge.boxes[np.abs(bridge.boxes[:, :, 1]).min(axis=1) < 1.5]
        assert crown[:, 0, 2].min(initial=np.inf) > CLEARANCE_M - 0.2
        assert bridge.half_across > road.wall_offset


def traced_from(bridge: Bridge, point: FloatArray, sun: FloatArray) -> bool:
    """Whether a ray from `point` to the sun meets a drawn triangle (Moeller and Trumbore, 1997)."""
    corners = bridge.triangles[:, :3].reshape(-1, 3, 3)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(sun, b)
    area = np.einsum("ij,ij->i", a, across)
    area = np.where(np.abs(area) > 1e-9, area, np.inf)
    from_corner = point - corners[:, 0]
    u = np.einsum("ij,ij->i", from_corner, across) / area
    turned = np.cross(from_corner, a)
    v = turned @ sun / area
    reach = np.einsum("ij,ij->i", b, turned) / area
    return bool(np.any((u >= 0) & (v >= 0) & (u + v <= 1) & (reach > 0.0)))


@pytest.mark.parametrize(("name", "seed"), [("highway", 3), ("circuit", 5), ("coast", 1)])
def test_bridge_shadows_match_ray_tracing(name: str, seed: int) -> None:
    """The mask equals a ray test against the rendered triangles."""
    road = Road(find_track(name), 2)
    sunny = light("clear", seed)
    sun = np.array(sunny.sun_direction)
    strip = np.zeros((120, round(road.track.length_m / shadow_mask.TEXEL_M)), dtype=np.uint8)
    along = road.track.length_m / strip.shape[1]
    over = bridges_of(road, seed)
    assert len(over) >= 3
    cast_bridges(strip, road, along, over, sunny)
    rng = np.random.default_rng(1)
    agreed, dark = [], 0
    for bridge in over:
        columns = (bridge.s + rng.uniform(-25.0, 25.0, 60)) / along
        rows = rng.uniform(-road.half_asphalt, road.half_asphalt, 60) / shadow_mask.TEXEL_M + 60
        for i, j in zip(rows.astype(int), columns.astype(int) % strip.shape[1], strict=True):
            value = strip[i, j]
            if 0 < value < 255:
                continue
            place = road.track.at((j + 0.5) * along, (i + 0.5 - 60) * shadow_mask.TEXEL_M)
            hidden = traced_from(bridge, np.array([place.x, place.y, place.z]), sun)
            agreed.append(hidden == (value == 255))
            dark += int(value == 255)
    assert dark > 15
    # Railings are drawn but cast no shadow.
    assert np.mean(agreed) > 0.93


def test_the_shadow_share_of_a_car_that_jumps_is_that_of_its_place() -> None:
    """Two parts of the road lie 36 m apart, so that the last place is no hint for the next one."""
    road = Road(find_track("random:3"), 2)
    light = Light.named("heavy-shadow", np.random.default_rng(1))
    before, after = standing_pose(road, 463.0, 1.5), standing_pose(road, 517.0, 1.5)
    with (
        Camera(road, CameraParameters(), seed=3, light=light) as fresh,
        Camera(road, CameraParameters(), seed=3, light=light) as jumping,
    ):
        expected = fresh.shadow_fraction(after)
        jumping.shadow_fraction(before, 463.0)
        assert jumping.shadow_fraction(after, 517.0) == expected
        jumping.render_views(before, near_s=463.0)
        found = jumping.render_views(after, near_s=517.0)["front"]
        assert np.array_equal(found, fresh.render(after))
