"""Options of the environments: observations, views, sensors, rewards, termination, videos."""

import gc
import math
import weakref
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import AddRenderObservation, RecordVideo, RenderCollection

import simulator.env  # registers the names
from simulator.camera import CLASSES, Camera, Light
from simulator.env.reward import Ending
from simulator.env.view_renderer import RenderOptions, ViewRenderer
from simulator.sensors import STANDARD, Sensor
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import CarState
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

STATE_ID = "driverview/LateralControl-v0"
IMAGE_ID = "driverview/DriverView-v0"
SMALL: dict[str, Any] = {"width": 64, "height": 48}
AHEAD = np.zeros(1, np.float32)


def spaces_of(name: str, **options: Any) -> dict[str, tuple[int, ...]]:
    """Shapes of an environment's first observation, checked against its space."""
    env = gym.make(name, track="oval", **SMALL, **options)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    moved, *_ = env.step(AHEAD)
    assert env.observation_space.contains(moved)
    env.close()
    parts = observation if isinstance(observation, dict) else {"": observation}
    return {key: part.shape for key, part in parts.items()}


@pytest.mark.parametrize(
    ("name", "options", "shapes"),
    [
        (STATE_ID, {}, {"": (7,)}),
        (IMAGE_ID, {}, {"state": (7,), "image": (48, 64, 3)}),
        (STATE_ID, {"observation": "image"}, {"": (48, 64, 3)}),
        (IMAGE_ID, {"observation": "image", "views": ["top"]}, {"": (48, 64, 3)}),
        (IMAGE_ID, {"observation": "state"}, {"": (7,)}),
        (STATE_ID, {"observation": "dict"}, {"state": (7,)}),
        (STATE_ID, {"sensors": ("range", "v_x")}, {"state": (7,), "range": (19,), "v_x": (1,)}),
        (STATE_ID, {"sensors": ("camera",)}, {"state": (7,), "camera": (48, 64, 3)}),
        (
            IMAGE_ID,
            {"views": ("front", "rear", "front:depth", "front:class"), "sensors": ("engine",)},
            {
                "state": (7,),
                "front": (48, 64, 3),
                "rear": (48, 64, 3),
                "front:depth": (48, 64),
                "front:class": (48, 64),
                "engine": (1,),
            },
        ),
    ],
)
def test_observation_parts_and_shapes_follow_the_options(
    name: str, options: dict[str, Any], shapes: dict[str, tuple[int, ...]]
) -> None:
    assert spaces_of(name, **options) == shapes


def test_views_equal_the_cameras_and_are_rendered_once_per_step() -> None:
    views = ("front", "rear", "left", "chase", "top", "front:depth", "rear:depth", "front:class")
    env = gym.make(IMAGE_ID, track="oval", views=views, render_mode="rgb_array", **SMALL).unwrapped
    assert isinstance(env, simulator.env.LateralControl)
    env.reset(seed=0)
    observation, *_ = env.step(AHEAD)
    world = env.world
    light = Light.named("clear", np.random.default_rng([0, 2]))
    with Camera(world.road, CameraParameters(**SMALL), seed=0, light=light) as camera:
        expected = camera.render_views(world.body_pose(), world.traffic.poses(), views)
    for view in views:
        limited = np.minimum(expected[view], 6000.0) if "depth" in view else expected[view]
        np.testing.assert_array_equal(observation[view], limited, err_msg=view)
    sky = observation["front:class"] == CLASSES.index("sky")
    assert 0.2 < sky.mean() < 0.8
    np.testing.assert_array_equal(sky, observation["front:depth"] == 6000.0)
    assert observation["front:depth"][-1].max() < 4.0  # the road before the bonnet
    for _ in range(2):
        shown = env.render()
        assert shown is not None
        np.testing.assert_array_equal(shown, observation["front"])
        shown[:] = 0  # the returned array is a copy
    env.close()


def test_calibration_projects_a_point_of_the_body_to_its_pixel() -> None:
    env = gym.make(
        IMAGE_ID, views=("front", "rear:depth"), mount=CameraParameters(x=1.0, z=1.2), **SMALL
    )
    calibration = env.unwrapped.calibration()  # type: ignore[attr-defined]
    env.close()
    focal = 24.0 / math.tan(math.radians(67.5 / 2))
    np.testing.assert_allclose(
        calibration["intrinsics"], [[focal, 0.0, 31.5], [0.0, focal, 23.5], [0.0, 0.0, 1.0]]
    )
    # 10 m before and 1.2 m below the eye: in the middle column, below the horizon.
    point = np.array([11.0, 0.0, 0.0, 1.0])
    u, v, depth = calibration["intrinsics"] @ (calibration["front"] @ point)[:3]
    assert (u / depth, v / depth, depth) == pytest.approx((31.5, 23.5 + focal * 0.12, 10.0))
    assert (calibration["rear:depth"] @ point)[2] == pytest.approx(-10.0)


def test_sensors_have_the_papers_units_and_the_requested_noise() -> None:
    options: dict[str, Any] = {"track": "oval", "sensors": ("v_x", "range", "engine")}
    exact, noisy = (
        gym.make(STATE_ID, **options),
        gym.make(STATE_ID, **options, sensor_noise={"v_x": 0.5}),
    )
    start = {"s": 300.0, "speed": 10.0}
    true, _ = exact.reset(seed=0, options=start)
    assert true["v_x"][0] == pytest.approx(36.0)
    readings = [noisy.reset(seed=seed, options=start)[0] for seed in range(150)]
    off = np.array([reading["v_x"][0] - 36.0 for reading in readings])
    assert np.std(off) == pytest.approx(0.5, rel=0.2)
    np.testing.assert_array_equal(readings[0]["range"], true["range"])
    again, _ = noisy.reset(seed=149, options=start)
    assert again["v_x"] == readings[149]["v_x"]
    assert noisy.step(AHEAD)[0]["v_x"] != pytest.approx(again["v_x"], abs=1e-3)
    exact.close()
    noisy.close()


def test_a_custom_sensor_is_in_the_observation() -> None:
    slip = Sensor(
        "side_slip",
        "rad",
        lambda world: math.atan2(world.state.vy, max(world.state.vx, 1.0)),
        limits=(-math.pi, math.pi),
        noise=0.01,
    )
    env = gym.make(STATE_ID, sensors=("v_x", slip))
    observation, _ = env.reset(seed=0)
    assert abs(observation["side_slip"][0]) < 0.05
    assert observation["side_slip"][0] != 0.0
    env.close()


@pytest.mark.contacts
def test_standard_sensor_readings_stay_in_their_spaces() -> None:
    names = [sensor.name for sensor in STANDARD]
    env = gym.make(STATE_ID, track="oval", traffic=3, sensors=names, ends=())
    env.reset(seed=0, options={"s": 100.0, "speed": 20.0})
    left_the_track = False
    for _ in range(60):
        observation, *_ = env.step(np.ones(1, np.float32))
        assert env.observation_space.contains(observation)
        left_the_track |= observation["range"][0] == -1.0
    assert left_the_track
    env.close()


def quadratic(state: CarState, road: Road, ending: Ending | None) -> float:
    """Negative quadratic cost, as in the paper's comparison of controllers."""
    return -(0.3 * state.to_middle**2 + state.angle**2 + 0.03 * state.steer**2)


def test_a_custom_reward_replaces_the_default() -> None:
    env = gym.make(STATE_ID, track="oval", reward=quadratic)
    env.reset(seed=0, options={"to_middle": 1.0, "angle": 0.1, "speed": 8.0})
    _, reward, *_, info = env.step(AHEAD)
    state = env.unwrapped.world.state  # type: ignore[attr-defined]
    assert reward == pytest.approx(-(0.3 * state.to_middle**2 + state.angle**2))
    assert info["score"] == reward
    env.close()


def test_a_reward_that_is_not_finite_is_refused() -> None:
    env = gym.make(STATE_ID, reward=lambda state, road, ending: math.nan)
    env.reset(seed=0)
    with pytest.raises(UserError, match="returned nan"):
        env.step(AHEAD)
    env.close()


@pytest.mark.parametrize(
    ("ends", "expected"),
    [
        (("off_track", "backwards", "collision"), "off_track"),
        # The wall stands behind the verge.
        pytest.param(("collision",), "collision", marks=pytest.mark.contacts),
        pytest.param((), "", marks=pytest.mark.contacts),
    ],
)
def test_only_events_in_ends_terminate_an_episode(ends: tuple[str, ...], expected: str) -> None:
    env = gym.make(STATE_ID, track="oval", ends=ends)
    env.reset(seed=0, options={"s": 100.0, "speed": 20.0, "angle": 0.4})
    farthest = 0.0
    for _ in range(60):
        _, reward, ended, _, info = env.step(AHEAD)
        farthest = max(farthest, abs(info["to_middle"]))
        if ended:
            break
    assert info["ended"] == expected
    assert (reward == -2.0) == bool(expected)
    assert farthest > 7.0  # beyond the edge
    env.close()


def test_driving_backwards_terminates_only_if_in_ends() -> None:
    for ends, expected in ((("backwards",), "backwards"), (("off_track",), "")):
        env = gym.make(STATE_ID, track="oval", ends=ends)
        env.reset(seed=0, options={"speed": -5.0})
        info = env.step(AHEAD)[4]
        assert info["ended"] == expected
        env.close()


def test_info_contains_only_features_that_are_present() -> None:
    env = gym.make(STATE_ID, track="oval", lanes=2)
    _, info = env.reset(seed=0, options={"to_middle": 2.0, "angle": 0.1})
    features = info["features"]
    assert (features["ml"], features["mr"]) == pytest.approx((-2.0, 2.0))
    assert (features["to_lane_centre"], features["angle"]) == pytest.approx((0.0, 0.1))
    assert features["heading"] == 1
    assert "m" not in features  # no marking within reach of the on-marking system
    env.close()


def test_a_vector_environment_stacks_features_with_presence_masks() -> None:
    vector = gym.make_vec(STATE_ID, 2, vectorization_mode="sync", track="oval", lanes=2)
    _, infos = vector.reset(seed=0, options={"to_middle": 0.0})
    np.testing.assert_array_equal(infos["features"]["_m"], [True, True])
    np.testing.assert_array_equal(infos["features"].get("_ml", [False, False]), [False, False])
    vector.close()


@pytest.mark.parametrize("view", ["front", "chase"])
def test_record_video_writes_every_frame(tmp_path: Path, view: str) -> None:
    env: gym.Env[Any, Any] = RecordVideo(
        gym.make(STATE_ID, render_mode="rgb_array", render_view=view, width=64, height=48),
        str(tmp_path / "videos"),
        disable_logger=True,
    )
    env.reset(seed=0)
    for _ in range(24):
        env.step(AHEAD)
    env.close()
    (path,) = tmp_path.glob("videos/*.mp4")
    video = cv2.VideoCapture(str(path))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(20.0)
    assert len(frames) == 25  # one of the reset and one per step
    assert frames[0].shape == (48, 64, 3)
    assert frames[0].std() > 10.0


def test_gymnasium_render_wrappers_return_the_images() -> None:
    env = gym.make(STATE_ID, render_mode="rgb_array", **SMALL)
    collected = RenderCollection(env)
    collected.reset(seed=0)
    collected.step(AHEAD)
    frames: Any = collected.render()
    assert [frame.shape for frame in frames] == [(48, 64, 3)] * 2
    observed, _ = AddRenderObservation(env, render_only=True).reset(seed=0)
    np.testing.assert_array_equal(observed, frames[0])
    env.close()


def test_the_place_of_a_picture_is_that_of_the_car_not_of_the_picture_before() -> None:
    """On a road that crosses itself, the camera tells by it where the car is."""
    env = gym.make(IMAGE_ID, track="oval", disable_env_checker=True, **SMALL)
    camera = mock.Mock()
    camera.render_views.return_value = {"front": np.zeros((48, 64, 3), np.uint8)}
    with mock.patch("simulator.camera.open_camera", return_value=camera):
        _, info = env.reset(seed=0, options={"s": 300.0})
    assert camera.render_views.call_args.kwargs == {"near_s": info["s"]}
    env.close()


def test_a_closed_renderer_does_not_keep_its_camera() -> None:
    """Each change of the road closes the camera; a training on random roads makes thousands."""
    renderer = ViewRenderer(Road(find_track("oval")), RenderOptions(width=32, height=24))
    cameras = []
    for _ in range(2):
        cameras.append(weakref.ref(renderer.camera))
        renderer.close()
    gc.collect()
    assert [camera() for camera in cameras] == [None, None]
