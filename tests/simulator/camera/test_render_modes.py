"""Depth and class of each pixel, and several views at once, against the track's own geometry."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.camera import CLASSES, VIEWS, Camera, Light
from simulator.camera.core.optics import eye_of, rotation
from simulator.camera.scene.cars import HEIGHT_M, LENGTH_M, WIDTH_M
from simulator.camera.snapshot import CLASS_COLOURS, colourise, standing_pose, write_contact_sheet
from simulator.track.catalogue import find_track
from simulator.track.markings import MarkingStyle
from simulator.track.road import Road
from simulator.varied.carriageway import Carriageway
from simulator.varied.look import RoadLook
from tests.simulator.track.track_samples import figure_of_eight
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

FloatArray = NDArray[np.float64]
ROAD, MARKING, CAR, GROUND, SKY, OBJECT = range(6)


@pytest.fixture(scope="module")
def road() -> Road:
    return Road(find_track("mountain-pass"), 2)


def light(kind: str = "clear") -> Light:
    return Light.named(kind, np.random.default_rng(1))


def rays(camera: Camera, pose: FloatArray, view: str = "front") -> tuple[FloatArray, FloatArray]:
    """The eye (3,), and each pixel's ray vector per metre of depth (height, width, 3)."""
    eye = eye_of(camera.parameters, pose, view)
    matrix = camera.intrinsics
    u = (np.arange(camera.width) - matrix[0, 2]) / matrix[0, 0]
    v = (np.arange(camera.height) - matrix[1, 2]) / matrix[1, 1]
    right, up, ahead = eye.axes
    return eye.place, ahead + u[None, :, None] * right - v[:, None, None] * up


def test_class_names_and_their_order() -> None:
    assert CLASSES == ("road", "marking", "car", "ground", "sky", "object")


@pytest.mark.parametrize("lanes", [1, 3])
def test_road_depth_equals_the_depth_of_the_track_surface(lanes: int) -> None:
    """The point that a road pixel shows, eye plus ray times depth, lies on the road plane."""
    road = Road(find_track("mountain-pass"), lanes)
    rng = np.random.default_rng(3)
    heights = []
    with Camera(road, seed=2, light=light()) as camera:
        for s in rng.uniform(0.0, road.track.length_m, 12):
            pose = standing_pose(road, s, rng.uniform(-1.0, 1.0), rng.normal(0.0, 0.05))
            found = camera.render_views(pose, views=("front:depth", "front:class"))
            depth, kind = found["front:depth"], found["front:class"]
            eye, ray = rays(camera, pose)
            near = ((kind == ROAD) | (kind == MARKING)) & (depth < 40.0)
            pick = rng.permutation(np.flatnonzero(near.reshape(-1)))[:150]
            points = eye + ray.reshape(-1, 3)[pick] * depth.reshape(-1)[pick, None]
            hint = s
            for x, y, z in points:
                at, offset = road.track.project(float(x), float(y), hint)
                heights.append(float(road.track.at(at, offset).z) - z)
                assert abs(offset) <= road.half_asphalt + 0.01
    assert len(heights) > 1500
    assert np.abs(heights).max() < 0.03
    assert np.median(np.abs(heights)) < 0.002


def places(camera: Camera, pose: FloatArray, depth: NDArray[np.float32]) -> FloatArray:
    """World places (height, width, 3) that the pixels show."""
    eye, ray = rays(camera, pose)
    return np.asarray(eye + ray * depth[..., None].astype(np.float64))


def test_marking_class_matches_the_painted_lines() -> None:
    """Each marking pixel lies on a painted line; no road pixel lies on an outer (solid) line."""
    track = replace(find_track("circuit"), markings=MarkingStyle())
    road = Road(track, 2)
    half = track.markings.line_width / 2
    rng = np.random.default_rng(4)
    on, off = [], []
    with Camera(road, seed=2, light=light()) as camera:
        for s in rng.uniform(0.0, track.length_m, 8):
            pose = standing_pose(road, s, rng.uniform(-1.0, 1.0), rng.normal(0.0, 0.05))
            found = camera.render_views(pose, views=("front:depth", "front:class"))
            depth, kind = found["front:depth"], found["front:class"]
            seen = places(camera, pose, depth)
            for x, y, _ in seen[(kind == MARKING) & (depth < 30.0)]:
                _, offset = track.project(float(x), float(y), s)
                on.append(np.abs(road.markings_y - offset).min())
            # Road pixels next to paint, where a mistake would be.
            beside = cv2.dilate((kind == MARKING).astype(np.uint8), np.ones((3, 3), np.uint8)) == 1
            for x, y, _ in seen[beside & (kind == ROAD) & (depth < 30.0)]:
                _, offset = track.project(float(x), float(y), s)
                off.append(np.abs(road.markings_y[[0, -1]] - offset).min())
    assert min(len(on), len(off)) > 1500
    assert max(on) < half + 0.01
    assert min(off) > half - 0.01


def test_car_class_and_depth_match_the_cars_box(road: Road) -> None:
    """The car's pixels cover most of its projected box, at depths within the box."""
    with Camera(road, CameraParameters(420, 315), seed=1, light=light()) as camera:
        pose = standing_pose(road, 100.0, 0.0)
        for gap, offset in ((10.0, 2.0), (22.0, -2.0), (35.0, 2.0)):
            car = standing_pose(road, 100.0 + gap, offset, height=0.0)
            found = camera.render_views(pose, car[None], ("front:depth", "front:class"))
            corners = np.array(
                [
                    (x, y, z)
                    for x in (-LENGTH_M / 2 - 0.1, LENGTH_M / 2 + 0.1)
                    for y in (-WIDTH_M / 2 - 0.1, WIDTH_M / 2 + 0.1)
                    for z in (0.0, HEIGHT_M)
                ]
            )
            pixels, away = camera.project(corners @ rotation(*car[3:]).T + car[:3], pose)
            box = np.zeros((camera.height, camera.width), np.uint8)
            hull = cv2.convexHull(np.rint(pixels * 16 - 8).astype(np.int32))
            cv2.fillConvexPoly(box, hull, 1, shift=4)
            drawn = found["front:class"] == CAR
            assert (drawn & (cv2.dilate(box, np.ones((3, 3), np.uint8)) == 0)).sum() == 0
            assert (drawn & (box == 1)).sum() > 0.5 * box.sum()
            depth = found["front:depth"][drawn]
            assert depth.min() > away.min() - 0.05
            assert depth.max() < away.max() + 0.05


def test_sky_class_matches_sky_coloured_pixels(road: Road) -> None:
    """Sky pixels are those coloured by a magenta sky in clear air."""
    magenta = (1.0, 0.0, 1.0)
    odd = replace(
        light(), zenith=magenta, horizon=magenta, haze=magenta, haze_per_km=1e-6, clouds=0.0
    )
    odd = replace(odd, sun=(0.0, 0.0, 0.0), sky=(0.3, 0.3, 0.3), exposure=1.0)
    with Camera(road, seed=3, light=odd) as camera:
        for s in (50.0, 400.0, 900.0):
            pose = standing_pose(road, s, 0.0)
            found = camera.render_views(pose, views=("front", "front:class", "front:depth"))
            is_sky = found["front:class"] == SKY
            assert np.array_equal(is_sky, np.isinf(found["front:depth"]))
            assert 0.05 < is_sky.mean() < 0.7
            red, green, blue = found["front"].astype(int).transpose(2, 0, 1)
            coloured = (np.minimum(red, blue) - green) > 128
            # Only the soft edges of leaves mix both colours.
            assert (coloured != is_sky).mean() < 0.004


def test_a_car_changes_colours_at_its_pixels_and_in_its_shadow(road: Road) -> None:
    with Camera(road, seed=1, light=light("overcast")) as camera:
        pose = standing_pose(road, 300.0, 0.0)
        car = standing_pose(road, 312.0, 1.5, height=0.0)
        found = camera.render_views(pose, car[None], ("front", "front:class"))
        empty = camera.render_views(pose, None, ("front", "front:class"))
    drawn = found["front:class"] == CAR
    assert not (empty["front:class"] == CAR).any()
    changed = np.abs(found["front"].astype(int) - empty["front"]).sum(axis=2) > 30
    assert changed[drawn].mean() > 0.9
    # Beside the car, only its shadow changes colour; the shadow lies below the car.
    beside = changed & ~drawn
    assert beside[: np.nonzero(drawn)[0].min()].sum() == 0
    same = ~(drawn | changed)
    assert np.array_equal(found["front:class"][same], empty["front:class"][same])


def test_objects_stand_beside_the_road(road: Road) -> None:
    """No object is less than 3 m above the asphalt; bridges are higher."""
    offsets = []
    with Camera(road, seed=5, light=light()) as camera:
        for s in np.linspace(0.0, road.track.length_m, 8, endpoint=False):
            pose = standing_pose(road, s, 0.0)
            found = camera.render_views(pose, views=("front:depth", "front:class"))
            near = (found["front:class"] == OBJECT) & (found["front:depth"] < 25.0)
            for x, y, z in places(camera, pose, found["front:depth"])[near][::7]:
                at, offset = road.track.project(float(x), float(y), s)
                if z - float(road.track.at(at, offset).z) < 3.0:
                    offsets.append(abs(offset))
    assert len(offsets) > 200
    assert min(offsets) > road.half_asphalt - 0.5


def test_a_bridge_of_the_road_leaves_the_road_below_it_free() -> None:
    """The figure of eight crosses itself at (0, 0): the lower road, along x, stays visible."""
    road = Road(figure_of_eight())
    pose = standing_pose(road, road.track.length_m - 25.0, 0.0)
    with Camera(road, seed=1, light=light()) as camera:
        found = camera.render_views(pose, views=("front:depth", "front:class"))
        seen = places(camera, pose, found["front:depth"])
    x, y, z = np.moveaxis(seen, -1, 0)
    on_asphalt = (np.abs(x) < 40.0) & (np.abs(y) < road.half_asphalt)
    assert ((z > 4.0) & on_asphalt & (found["front:class"] == OBJECT)).sum() > 500  # the underside
    lower = on_asphalt & (z < 4.0)
    assert np.abs(z[lower]).max() < 0.1
    assert (lower & (x > 10.0)).sum() > 50  # beyond the bridge
    assert np.isin(found["front:class"][lower], (ROAD, MARKING)).all()


def test_depth_of_the_top_view_is_the_camera_height(road: Road) -> None:
    pose = standing_pose(road, 200.0, 0.0)
    with Camera(road, CameraParameters(64, 64), seed=1, light=light()) as camera:
        found = camera.render_views(pose, views=("top:depth", "top:class"))
        depth, kind = found["top:depth"], found["top:class"]
    assert kind[32, 32] == CAR
    assert 22.0 < depth[32, 32] < 23.5
    beside = depth[kind == ROAD]
    assert np.median(beside) == pytest.approx(24.25, abs=0.3)


def test_classes_are_the_same_in_rain_and_snow(road: Road) -> None:
    pose = standing_pose(road, 250.0, 1.0)
    found = []
    for kind in ("overcast", "rain", "snow"):
        with Camera(road, seed=4, light=light(kind)) as camera:
            found.append(camera.render_views(pose, views=("front:class", "front:depth")))
    for other in found[1:]:
        assert np.array_equal(found[0]["front:class"], other["front:class"])
        assert np.array_equal(found[0]["front:depth"], other["front:depth"])


def test_views_rendered_together_equal_views_rendered_singly(road: Road) -> None:
    names = [f"{view}{kind}" for view in VIEWS for kind in ("", ":depth", ":class")]
    pose = standing_pose(road, 70.0, -1.0)
    cars = np.array([standing_pose(road, 85.0, 2.0, height=0.0)])
    with Camera(road, seed=1, light=light()) as camera:
        together = camera.render_views(pose, cars, names[::-1])
        assert list(together) == names[::-1]
        for name in names:
            alone = camera.render_views(pose, cars, (name,))[name]
            assert np.array_equal(together[name], alone), name
        for view in VIEWS:
            assert np.array_equal(together[view], camera.render(pose, cars, view))
            assert together[view].shape == (210, 280, 3)
            assert together[f"{view}:depth"].shape == (210, 280)
            assert together[f"{view}:depth"].dtype == np.float32
            assert together[f"{view}:class"].dtype == np.uint8
        assert camera.render_views(pose, cars, ()) == {}


def test_unknown_views_and_kinds_are_refused(road: Road) -> None:
    pose = standing_pose(road, 0.0, 0.0)
    with Camera(road, CameraParameters(16, 16), seed=1, light=light()) as camera:
        for name in ("below", "below:depth", ""):
            with pytest.raises(UserError, match="the views are front, left, right, rear, chase"):
                camera.render_views(pose, views=("front", name))
        for name in ("front:depths", "front:", "front:depth:class"):
            with pytest.raises(UserError, match="the kinds are colour, depth, class"):
                camera.render_views(pose, views=(name,))
        with pytest.raises(UserError, match="unknown camera view 'below'"):
            camera.extrinsics("below")


@pytest.mark.parametrize("view", VIEWS)
def test_calibration_matches_the_projection(road: Road, view: str) -> None:
    """K E p is the projection of a point p of the body frame, for any size, lens and pose."""
    rng = np.random.default_rng(6)
    pose = np.array([31.0, -12.0, 4.0, 0.05, -0.1, 2.2])
    points = rng.uniform(-30.0, 30.0, (200, 3))
    parameters = CameraParameters(352, 160, x=0.4, y=0.2, z=1.3, pitch_deg=7.0, fov_y_deg=41.0)
    with Camera(road, parameters, seed=1, light=light()) as camera:
        matrix, frame = camera.intrinsics, camera.extrinsics(view, pose)
        world = points @ rotation(*pose[3:]).T + pose[:3]
        pixels, depth = camera.project(world, pose, view)
        if view not in ("chase", "top"):
            assert frame == pytest.approx(camera.extrinsics(view))
    assert frame[3] == pytest.approx([0.0, 0.0, 0.0, 1.0])
    assert frame[:3, :3] @ frame[:3, :3].T == pytest.approx(np.eye(3))
    assert np.linalg.det(frame[:3, :3]) == pytest.approx(1.0)
    seen = np.column_stack([points, np.ones(len(points))]) @ frame.T
    assert seen[:, 2] == pytest.approx(depth)
    ahead = depth > 0.5
    homogeneous = seen[ahead, :3] @ matrix.T
    assert homogeneous[:, :2] / homogeneous[:, 2:] == pytest.approx(pixels[ahead])
    assert ahead.sum() > 50


@pytest.mark.parametrize("size", [(280, 210), (64, 48), (1920, 1080), (100, 300)])
@pytest.mark.parametrize("fov", [20.0, 67.5, 120.0])
def test_intrinsics_follow_size_and_field_of_view(size: tuple[int, int], fov: float) -> None:
    width, height = size
    matrix = CameraParameters(width, height, fov).intrinsics()
    up, down = (np.arctan((v - matrix[1, 2]) / matrix[1, 1]) for v in (-0.5, height - 0.5))
    assert np.degrees(down - up) == pytest.approx(fov)
    centre = ((width - 1) / 2, (height - 1) / 2)
    assert (matrix[0, 2], matrix[1, 2], matrix[0, 0]) == (*centre, matrix[1, 1])


def test_colourise_maps_depth_and_class_to_colours(road: Road) -> None:
    depth = np.array([[2.0, 30.0, 499.0, np.inf]], dtype=np.float32)
    near, middle, far, sky = colourise(depth, "depth")[0].astype(int)
    assert near[0] > near[2]
    assert middle[1] > middle[0]
    assert far[2] > far[0]
    assert sky.max() < 20
    classes = np.arange(len(CLASSES), dtype=np.uint8)[None]
    colours = colourise(classes, "class")[0]
    assert [tuple(colour) for colour in colours.tolist()] == list(CLASS_COLOURS.values())
    picture = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    assert np.array_equal(colourise(picture, "colour"), picture)


def test_a_contact_sheet_of_one_view_and_kind(road: Road, tmp_path: Path) -> None:
    """All pixels but the captions have class colours; rear and front view differ."""
    sheets = []
    for view in ("rear", None):
        out = tmp_path / f"{view}.png"
        write_contact_sheet(road, out, seed=0, traffic=1, light="clear", view=view, kind="class")
        sheet = cv2.imread(str(out))
        assert sheet is not None
        sheets.append(sheet[..., ::-1].astype(int))
    palette = np.array(list(CLASS_COLOURS.values()))
    known = (sheets[0][:, :, None] == palette).all(axis=-1).any(axis=-1)
    assert known.mean() > 0.98
    assert (sheets[0] != sheets[1]).any(axis=-1).mean() > 0.1


def test_the_lines_of_a_varied_road_have_their_class_to_the_end_of_a_long_lap() -> None:
    """Distances along the lap are float32 in the shader: beyond 1 km their spacing is 0.1 mm."""
    road = Road.varied(find_track("highway"), Carriageway.drawn(3, 2))
    counts = {}
    with Camera(road, seed=3, light=light(), look=RoadLook(), scenes=1) as camera:
        for s in (400.0, 1300.0, 3000.0):
            kind = camera.render_views(standing_pose(road, s, 0.0), views=("front:class",))
            counts[s] = int((kind["front:class"] == MARKING).sum())
    assert min(counts[1300.0], counts[3000.0]) > 0.6 * counts[400.0] > 0


def test_patches_whose_paint_is_worn_away_are_road() -> None:
    track = find_track("coast")
    worn = replace(track, markings=replace(track.markings, wear=1.0, left_colour="white"))
    camera = CameraParameters(1120, 840)
    overcast = Light.named("overcast", np.random.default_rng(0))
    dark = total = 0
    with Camera(Road(worn, 1), camera, seed=5, light=overcast) as drawn:
        for s in range(100, 500, 100):
            found = drawn.render_views(
                standing_pose(drawn.road, s, 0.0), views=("front", "front:class")
            )
            kind, grey = found["front:class"][520:], found["front"][520:].mean(2)
            marked = cv2.erode((kind == MARKING).astype(np.uint8), np.ones((3, 3), np.uint8)) == 1
            dark += int((grey[marked] < np.median(grey[kind == ROAD]) + 12).sum())
            total += int(marked.sum())
    assert total > 1000
    assert dark < 0.01 * total
