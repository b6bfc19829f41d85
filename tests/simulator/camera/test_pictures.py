"""Rendered images: sizes, views, determinism, lights, shadows, cars, memory."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from simulator.camera import KINDS, VIEWS, Camera, Light
from simulator.camera.core import context as camera_context
from simulator.camera.overlay import marking_polylines
from simulator.camera.scene.cars import WIDTH_M
from simulator.camera.snapshot import standing_pose, write_contact_sheet
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from tests.simulator.track.track_samples import figure_of_eight
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError


@pytest.fixture(scope="module")
def road() -> Road:
    return Road(find_track("countryside"), 2)


def light(kind: str = "clear", seed: int = 1) -> Light:
    return Light.named(kind, np.random.default_rng(seed))


def test_the_same_seed_gives_the_same_bytes(road: Road) -> None:
    pose = standing_pose(road, 120.0, 0.5, 0.03)
    cars = np.array([standing_pose(road, 140.0, 2.0, height=0.0)])
    pictures = []
    for seed in (4, 4, 5):
        with Camera(road, seed=seed, light=light()) as camera:
            camera.render(standing_pose(road, 10.0, 0.0), view="rear")
            pictures.append(camera.render(pose, cars))
    assert np.array_equal(pictures[0], pictures[1])
    assert np.mean(pictures[0] != pictures[2]) > 0.05


def test_another_process_draws_the_same_bytes() -> None:
    code = (
        "import hashlib, numpy as np\n"
        "from simulator.camera import Camera, Light\n"
        "from simulator.camera.snapshot import standing_pose\n"
        "from simulator.track.catalogue import find_track\n"
        "from simulator.track.road import Road\n"
        "road = Road(find_track('town'), 1)\n"
        "camera = Camera(road, seed=3, light=Light.named('dusk', np.random.default_rng(2)))\n"
        "print(hashlib.sha256(camera.render(standing_pose(road, 50.0, 0.0))).hexdigest())\n"
    )
    runs = [
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        for _ in range(2)
    ]
    assert runs[0].stdout == runs[1].stdout
    assert len(runs[0].stdout.strip()) == 64


@pytest.mark.parametrize("size", [(64, 64), (280, 210), (333, 97), (640, 480)])
def test_images_of_any_size_show_sky_above_asphalt(road: Road, size: tuple[int, int]) -> None:
    width, height = size
    with Camera(road, CameraParameters(width, height), seed=1, light=light()) as camera:
        picture = camera.render(standing_pose(road, 30.0, 0.0))
        matrix = camera.intrinsics
    assert picture.shape == (height, width, 3)
    assert picture.dtype == np.uint8
    assert matrix[0, 0] == matrix[1, 1]
    assert (matrix[0, 2], matrix[1, 2]) == ((width - 1) / 2, (height - 1) / 2)
    assert 2 * np.degrees(np.arctan(height / 2 / matrix[1, 1])) == pytest.approx(67.5)
    # Blue above, grey asphalt below.
    sky = picture[: height // 8].reshape(-1, 3).mean(axis=0)
    asphalt = picture[-height // 8 :, width // 3 : width // 2].reshape(-1, 3).mean(axis=0)
    assert sky[2] > sky[0] + 10
    assert np.ptp(asphalt) < 20
    assert sky.sum() > asphalt.sum()


def test_views_differ_from_each_other(road: Road) -> None:
    with Camera(road, seed=1, light=light()) as camera:
        pose = standing_pose(road, 200.0, 1.0)
        pictures = {view: camera.render(pose, view=view).astype(np.float64) for view in VIEWS}
        with pytest.raises(UserError, match="the views are front"):
            camera.render(pose, view="below")
    for view, picture in pictures.items():
        assert picture.std() > 8.0, view
        for other in VIEWS:
            if other != view:
                assert np.abs(picture - pictures[other]).mean() > 5.0, (view, other)


def test_projection_follows_the_mount(road: Road) -> None:
    """A point straight ahead of the mount projects to the middle, one to the left, left of it."""
    pose = np.array([10.0, 20.0, 3.0, 0.0, 0.0, np.pi / 2])
    with Camera(road, CameraParameters(x=1.0, z=0.5), seed=1, light=light()) as camera:
        points = np.array([[10.0, 31.0, 3.5], [9.0, 31.0, 3.5], [10.0, 31.0, 4.5], [10, 0, 3.5]])
        pixels, depth = camera.project(points, pose)
        focal = camera.intrinsics[0, 0]
    assert depth == pytest.approx([10.0, 10.0, 10.0, -21.0])
    assert pixels[0] == pytest.approx([139.5, 104.5])
    assert pixels[1] == pytest.approx([139.5 - focal / 10, 104.5])
    assert pixels[2] == pytest.approx([139.5, 104.5 - focal / 10])
    assert np.isnan(pixels[3]).all()


def test_a_car_is_drawn_at_its_projected_pose(road: Road) -> None:
    with Camera(road, seed=1, light=light("overcast")) as camera:
        pose = standing_pose(road, 100.0, 0.0)
        alone = camera.render(pose).astype(np.float64)
        for gap, y in ((12.0, 2.0), (25.0, -2.0), (40.0, 2.0)):
            car = standing_pose(road, 100.0 + gap, y, height=0.0)
            changed = np.abs(camera.render(pose, car[None]) - alone).sum(axis=2) > 40
            rows, columns = np.nonzero(changed)
            rear = standing_pose(road, 100.0 + gap - 2.2, y, height=0.0)[:3]
            (foot,), (depth,) = camera.project(rear[None], pose)
            focal = camera.intrinsics[0, 0]
            assert np.median(columns) == pytest.approx(foot[0], abs=0.35 * focal / depth)
            assert rows.max() == pytest.approx(foot[1], abs=0.35 * focal / depth + 2)
            assert np.ptp(columns) == pytest.approx(WIDTH_M * focal / depth, rel=0.4)


@pytest.mark.parametrize("lanes", [1, 3])
def test_heavy_shadow_has_the_specified_contrast_and_coverage(lanes: int) -> None:
    """At most 0.4 of the lit luminance, over 30 to 80 % of the road within 30 m."""
    road = Road(find_track("forest"), lanes)
    rng = np.random.default_rng(8)
    with Camera(road, seed=7, light=light("heavy-shadow", 3)) as camera:
        places = rng.uniform(0.0, road.track.length_m, 60)
        poses = [standing_pose(road, s, 0.0) for s in places]
        shares = [camera.shadow_fraction(pose) for pose in poses]
        ratios = []
        for pose in poses[:12]:
            grey = camera.render(pose).astype(np.float64)[150:].mean(axis=2)
            dark, bright = np.percentile(grey, [12, 88])
            ratios.append(dark / bright)
    assert min(shares) >= 0.3
    assert max(shares) <= 0.8
    # Display values; in light itself the ratio is the square of this.
    assert np.median(ratios) < 0.45
    assert np.median(np.square(ratios)) < 0.4


def test_overcast_and_fog_cast_no_hard_shadows(road: Road) -> None:
    pose = standing_pose(road, 100.0, 0.0)
    for kind in ("overcast", "fog"):
        with Camera(road, seed=1, light=light(kind)) as camera:
            assert camera.shadow_fraction(pose) == 0.0


def test_lights_differ_by_kind_and_by_seed(road: Road) -> None:
    pose = standing_pose(road, 60.0, 0.0)
    pictures = []
    for kind in KINDS:
        for seed in (1, 2):
            with Camera(road, seed=1, light=light(kind, seed)) as camera:
                pictures.append(camera.render(pose).astype(np.float64))
    for i, one in enumerate(pictures):
        assert 25.0 < one.mean() < 215.0
        for other in pictures[i + 1 :]:
            assert np.abs(one - other).mean() > 2.0
    with pytest.raises(UserError, match="unknown light 'noon'"):
        light("noon")


def test_a_closed_camera_raises(road: Road) -> None:
    camera = Camera(road, seed=1, light=light())
    camera.close()
    camera.close()
    with pytest.raises(RuntimeError, match="closed"):
        camera.render(np.zeros(6))


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux's /proc")
def test_closed_cameras_free_their_memory(road: Road) -> None:
    """Ten cameras, opened and closed, add less than 8 MB (llvmpipe's textures are in memory)."""

    def resident_mb() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

    def draw_once(seed: int) -> None:
        with Camera(road, seed=seed, light=light()) as camera:
            camera.render(standing_pose(road, 10.0, 0.0))

    for seed in range(4):
        draw_once(seed)
    before = resident_mb()
    for seed in range(10):
        draw_once(seed)
    assert resident_mb() - before < 8.0


def test_invalid_sizes_and_fields_of_view_are_refused(road: Road) -> None:
    with pytest.raises(UserError, match="picture size 0 x 210"):
        Camera(road, CameraParameters(width=0), seed=1, light=light())
    with pytest.raises(UserError, match="field of view"):
        CameraParameters(fov_y_deg=180.0)


def test_error_without_egl_names_the_packages_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    import moderngl

    def refuse(**_: object) -> None:
        raise ImportError("libEGL.so not loaded")

    monkeypatch.setattr(moderngl, "create_context", refuse)
    with pytest.raises(UserError, match="apt-get install libegl1 libgl1 libgl1-mesa-dri"):
        camera_context.Graphics()


def test_overlay_lines_coincide_with_the_markings(road: Road) -> None:
    pose = standing_pose(road, 150.0, 0.0)
    with Camera(road, seed=1, light=light()) as camera:
        lines = marking_polylines(camera, road, (150.0, pose))
    assert len(lines) == 3
    left, middle, right = (line[np.argmax(line[:, 1])] for line in lines)
    assert left[0] < middle[0] < right[0]


def test_contact_sheet_size_and_refused_arguments(road: Road, tmp_path: Path) -> None:
    import cv2

    out = tmp_path / "sheet.png"
    write_contact_sheet(road, out, seed=0, traffic=2)
    sheet = cv2.imread(str(out))
    assert sheet is not None
    assert sheet.shape == (4 * 360, 4 * 480, 3)
    with pytest.raises(UserError, match=r"ends in \.png"):
        write_contact_sheet(road, tmp_path / "sheet.gif", seed=0, traffic=0)
    with pytest.raises(UserError, match="unknown light 'noon'"):
        write_contact_sheet(road, tmp_path / "noon.png", seed=0, traffic=0, light="noon")
    assert list(tmp_path.iterdir()) == [out]


def test_a_contact_sheet_in_one_light(road: Road, tmp_path: Path) -> None:
    import cv2

    write_contact_sheet(road, tmp_path / "snow.png", seed=0, traffic=0, light="snow")
    sheet = cv2.imread(str(tmp_path / "snow.png"))
    assert sheet is not None
    blue = 0
    for k in range(14):  # the driver views; in half of those of a mixed sheet the sky is blue
        row, column = divmod(k, 4)
        sky = sheet[360 * row : 360 * row + 100, 480 * column : 480 * column + 480].astype(int)
        blue += int((sky[..., 0] - sky[..., 2]).mean() > 15.0)
    assert blue <= 1  # a bridge of blue steel may hang over the car


def test_a_track_of_unknown_look_gets_a_countryside(road: Road) -> None:
    strange = Road(replace(road.track, look="moon"), 1)
    with Camera(strange, seed=1, light=light()) as camera:
        assert camera.render(standing_pose(strange, 10.0, 0.0)).std() > 8.0


def test_where_the_road_crosses_itself_the_given_place_counts_not_the_picture_before() -> None:
    track = figure_of_eight()
    camera = Camera.__new__(Camera)  # without a scene
    camera.road = Road(track)
    upper = 0.5 * track.length_m
    for before in (5.0, upper + 5.0):
        for near in (5.0, upper + 5.0):
            camera._last_s = before
            with mock.patch.object(Camera, "_views", return_value={}):
                camera.render_views(np.zeros(6), near_s=near)
            x, y = (float(value) for value in (track.at(near).x, track.at(near).y))
            assert camera._s_of(0.05 * x, 0.05 * y) == pytest.approx(near, abs=5.0)
