"""Sensors: range beams against brute force and closed forms, units, noise, custom sensors."""

import math
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

import simulator.env  # noqa: F401 registers the environments
from simulator.camera import Camera, Light
from simulator.sensors.beams import BEAM_ANGLES, RANGE_M, shorten_at_boxes, track_beams
from simulator.sensors.sensor import Sensor, SensorSuite
from simulator.sensors.standard import STANDARD, camera_sensor, read_range, read_track_range
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.traffic.traffic import TRAFFIC_CAR_SIZE
from simulator.world.world import Command, World
from tests.simulator.oracles import BruteForce
from tests.simulator.track.track_samples import figure_of_eight
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError


def beams_from(road: Road, x: float, y: float, yaw: float) -> NDArray[np.float64]:
    beams = np.empty(len(BEAM_ANGLES))
    track_beams(road.track.arrays(), -1, x, y, yaw, BEAM_ANGLES, road.edge, beams)
    return beams


@pytest.mark.parametrize(("name", "lanes"), [("circuit", 1), ("mountain-pass", 3)])
def test_range_beams_agree_with_brute_force(name: str, lanes: int) -> None:
    road = Road(find_track(name), lanes)
    oracle = BruteForce(road, 0.05)
    rng = np.random.default_rng(4)
    for _ in range(12):
        s = float(rng.uniform(0.0, road.track.length_m))
        d = float(rng.uniform(-0.95, 0.95) * road.edge)
        pose = road.track.at(s, d)
        x, y, yaw = float(pose.x), float(pose.y), float(pose.heading) + float(rng.normal(0, 0.3))
        beams = beams_from(road, x, y, yaw)
        expected = oracle.distances(x, y, yaw, BEAM_ANGLES)
        np.testing.assert_allclose(beams, expected, atol=2e-3)


@pytest.mark.parametrize(("name", "lanes", "traffic"), [("circuit", 1, 0), ("town", 3, 12)])
def test_range_and_range_traffic_agree_with_brute_force_in_a_drive(
    name: str, lanes: int, traffic: int
) -> None:
    road = Road(find_track(name), lanes)
    oracle = BruteForce(road)
    cut_short = 0
    with World(road, traffic=traffic) as world:
        now = world.reset(seed=3, speed=8.0)
        for step in range(200):
            wheel = 2.0 * now.angle - 0.2 * (now.to_middle - math.sin(step / 20))
            now = world.step(Command(steer=min(max(wheel, -1.0), 1.0), throttle=0.2))
            place = (now.x, now.y, now.yaw, BEAM_ANGLES)
            to_edge, to_anything = read_track_range(world), read_range(world)
            np.testing.assert_allclose(to_edge, oracle.distances(*place), atol=0.02)
            cars = world.traffic.poses()
            expected = oracle.distances(*place, boxes=cars, size=TRAFFIC_CAR_SIZE[:2])
            np.testing.assert_allclose(to_anything, expected, atol=0.02)
            cut_short += int(np.count_nonzero(to_anything < to_edge))
    assert (cut_short > 20) == (traffic > 0)


def test_sideways_beams_on_a_straight_measure_to_its_edges() -> None:
    with World(Road(find_track("oval"))) as world:
        s = _straight(world.road)
        world.reset(seed=0, s=s, to_middle=1.0)
        beams = read_track_range(world)
        assert beams.shape == (19,)
        assert beams[0] == pytest.approx(world.road.edge - 1.0, abs=1e-6)  # +90 deg: left
        assert beams[-1] == pytest.approx(world.road.edge + 1.0, abs=1e-6)
        assert beams[3] == pytest.approx((world.road.edge - 1.0) / math.sin(math.radians(60)))


def test_off_the_track_all_beams_are_minus_one() -> None:
    road = Road(find_track("oval"))
    pose = road.track.at(50.0, road.edge + 0.1)
    beams = beams_from(road, float(pose.x), float(pose.y), 0.0)
    np.testing.assert_array_equal(beams, -1.0)


def test_a_beam_ends_at_a_box() -> None:
    beams = np.full(len(BEAM_ANGLES), RANGE_M)
    box = np.array([[20.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 10.0, 0.0, 0.0, 0.0, math.pi / 2]])
    shorten_at_boxes(beams, 0.0, 0.0, 0.0, BEAM_ANGLES, box, 4.4, 1.8)
    assert beams[9] == pytest.approx(20.0 - 2.2)  # straight ahead
    assert beams[0] == pytest.approx(10.0 - 2.2)  # to the left, the box stands crosswise
    assert beams[-1] == RANGE_M
    assert beams[8] == RANGE_M  # 10 deg passes 3.1 m to the left of the box ahead


def test_only_range_traffic_detects_traffic() -> None:
    with World(Road(find_track("oval")), traffic=1) as world:
        s = _straight(world.road)
        world.reset(seed=0, s=s)
        ahead = 0.0
        for _ in range(1500):
            wheel = 2.0 * world.state.angle - world.state.to_middle
            world.step(Command(steer=min(max(wheel, -1.0), 1.0), throttle=0.4))
            gap = world.traffic.leader(world.state.s, world.state.to_middle)
            # Within 10 m, road and cars are nearly straight.
            if gap is not None and gap[0] < 10.0:
                ahead = gap[0] + 4.52 / 2  # the beams start at the centre of gravity
                break
        assert ahead > 0.0
        assert read_range(world)[9] == pytest.approx(ahead, abs=0.5)
        assert read_track_range(world)[9] > ahead + 1.0


def test_a_car_on_a_bridge_is_on_another_level() -> None:
    """The figure of eight crosses itself at (0, 0); its upper road is 6 m higher."""
    with World(Road(figure_of_eight()), traffic=1) as world:
        world.reset(seed=0, s=world.road.track.length_m - 30.0, to_middle=0.0)
        free = read_track_range(world)[9]
        for height, expected in ((0.0, 30.0 - TRAFFIC_CAR_SIZE[0] / 2), (6.0, free)):
            pose = np.array([[0.0, 0.0, height, 0.0, 0.0, 0.0]])
            with mock.patch.object(type(world.traffic), "poses", return_value=pose):
                assert read_range(world)[9] == pytest.approx(expected, abs=0.01)


def test_readings_have_the_papers_units() -> None:
    with World(Road(find_track("oval"))) as world:
        world.reset(seed=0, s=_straight(world.road), speed=15.0, angle=0.05)
        state = world.step(Command(throttle=0.2))
        readings = SensorSuite(STANDARD).read(world)
    assert readings["speed"] == pytest.approx(3.6 * state.speed)
    assert readings["v_x"] == pytest.approx(3.6 * state.vx)
    assert readings["v_y"] == pytest.approx(3.6 * state.vy)
    assert readings["angle"] == state.angle
    assert readings["engine"] == pytest.approx(394 * state.vx, rel=0.01)
    assert readings["wheel_spin_front_left"] == pytest.approx(state.vx / 0.3273, rel=0.01)
    assert readings["odometer"] == pytest.approx(0.75, rel=0.01)
    assert readings["lap_timer"] == pytest.approx(0.05)


def test_standard_sensors_are_those_of_the_papers_table() -> None:
    inf, pi = math.inf, math.pi
    table = {
        "range": (0.0, 200.0, "m"),
        "angle": (-pi, pi, "rad"),
        "speed": (0.0, 200.0, "km/h"),
        "v_x": (-200.0, 200.0, "km/h"),  # signed, unlike the paper's
        "v_y": (-50.0, 50.0, "km/h"),
        "engine": (0.0, 10_000.0, "rpm"),
        "odometer": (0.0, inf, "m"),
        "lap_timer": (0.0, inf, "s"),
        "wheel_spin_front_left": (0.0, inf, "rad/s"),
        "wheel_spin_front_right": (0.0, inf, "rad/s"),
        "wheel_spin_rear_left": (0.0, inf, "rad/s"),
        "wheel_spin_rear_right": (0.0, inf, "rad/s"),
    }
    declared = {sensor.name: (*sensor.limits, sensor.unit) for sensor in STANDARD}
    assert declared == table | {"range_traffic": table["range"]}


def test_camera_sensor_returns_the_rendered_image() -> None:
    road = Road(find_track("oval"))
    light = Light.named("clear", np.random.default_rng(0))
    camera_parameters = CameraParameters(96, 72)
    with World(road) as world, Camera(road, camera_parameters, seed=0, light=light) as camera:
        world.reset(seed=0)
        sensors = [camera_sensor(camera), camera_sensor(camera, "rear")]
        exact = SensorSuite(sensors).read(world)
        grainy = SensorSuite(sensors, seed=1, noise={"camera": 12.0}).read(world)
        assert sensors[0].limits == (0.0, 255.0)
        picture = camera.render(world.body_pose())
    np.testing.assert_array_equal(exact["camera"], picture)
    np.testing.assert_array_equal(grainy["camera_rear"], exact["camera_rear"])
    grain = np.asarray(grainy["camera"], np.float64) - picture
    assert np.asarray(grainy["camera"]).dtype == np.uint8
    assert np.std(grain[(picture > 60) & (picture < 190)]) == pytest.approx(12.0, rel=0.05)


def test_readings_are_clipped_to_the_limits() -> None:
    with World(Road(find_track("oval"))) as world:
        world.reset(seed=0, speed=80.0)
        readings = SensorSuite(STANDARD).read(world)
        assert (readings["speed"], readings["v_x"]) == (200.0, 200.0)
        world.reset(seed=0, speed=-10.0)
        readings = SensorSuite(STANDARD).read(world)
    assert readings["v_x"] == pytest.approx(-36.0)
    assert readings["speed"] == pytest.approx(36.0)  # the table's is a magnitude
    assert readings["wheel_spin_rear_left"] == pytest.approx(10.0 / 0.3273)


def test_a_user_adds_a_sensor_in_one_line() -> None:
    slip = Sensor("side_slip", "rad", lambda world: math.atan2(world.state.vy, world.state.vx))
    suite = SensorSuite([*STANDARD, slip])
    with World(Road(find_track("oval"))) as world:
        world.reset(seed=0, speed=10.0)
        assert suite.read(world)["side_slip"] == pytest.approx(0.0, abs=1e-12)


def test_noisy_readings_of_an_integer_type_are_rounded() -> None:
    """Truncated readings would have a mean 0.5 below the exact reading."""
    sensors = [
        Sensor("gear", "-", lambda _: 3, noise=2.0, dtype="int32"),
        Sensor("gears", "-", lambda _: np.full(4, 3.0), noise=2.0, shape=(4,), dtype="int32"),
        Sensor("share", "-", lambda _: 2.7, dtype="int16"),
    ]
    env = gym.make("driverview/LateralControl-v0", track="oval", sensors=sensors)
    seen = [env.reset(seed=seed)[0] for seed in range(1000)]
    assert np.mean([one["gear"] for one in seen]) == pytest.approx(3.0, abs=0.25)
    assert np.mean([one["gears"] for one in seen]) == pytest.approx(3.0, abs=0.12)
    assert seen[0]["share"].tolist() == [3]
    env.close()


@pytest.mark.parametrize("dtype", ["uint8", "int8", "int32", "int64", "uint64"])
def test_readings_of_an_integer_type_without_limits_stay_in_its_range(dtype: str) -> None:
    sensors = [
        Sensor("low", "-", lambda _: -1e30, dtype=dtype),
        Sensor("high", "-", lambda _: np.full(2, 1e30), shape=(2,), dtype=dtype),
    ]
    env = gym.make("driverview/LateralControl-v0", track="oval", sensors=sensors)
    seen = env.reset(seed=1)[0]
    assert seen["low"].tolist() == [np.iinfo(dtype).min]
    assert min(seen["high"].tolist()) == pytest.approx(np.iinfo(dtype).max)
    env.close()


def test_noise_is_off_by_default_seeded_and_of_the_size_asked_for() -> None:
    with World(Road(find_track("oval"))) as world:
        world.reset(seed=0, speed=10.0)
        exact = SensorSuite(STANDARD).read(world)
        suite = SensorSuite(STANDARD, seed=7, noise={"angle": 0.02, "range": 0.5})
        first = [suite.read(world) for _ in range(400)]
        suite.restart()
        assert suite.read(world)["angle"] == first[0]["angle"]
    assert first[0]["speed"] == exact["speed"]
    angles = np.array([reading["angle"] for reading in first])
    assert np.std(angles) == pytest.approx(0.02, rel=0.15)
    ranges = np.array([reading["range"] for reading in first]) - exact["range"]
    assert np.std(ranges) == pytest.approx(0.5, rel=0.05)


def test_noise_keeps_limits_and_the_off_track_value() -> None:
    with World(Road(find_track("oval"))) as world:
        world.reset(seed=0, s=_straight(world.road))
        suite = SensorSuite(STANDARD, seed=7, noise={"range": 300.0})
        seen = np.array([suite.read(world)["range"] for _ in range(50)])
        assert (seen.min(), seen.max()) == (0.0, 200.0)
        while not world.step(Command(steer=1.0, throttle=1.0)).off_track:
            pass
        np.testing.assert_array_equal(suite.read(world)["range"], np.full(19, -1.0))


def test_the_noise_of_a_scalar_does_not_depend_on_earlier_invalid_readings() -> None:
    def read(values: list[float]) -> list[float]:
        left = iter(values)
        sensor = Sensor(
            "a", "m", lambda _: next(left), limits=(0.0, 99.0), noise=1.0, invalid=-99.0
        )
        rng = np.random.default_rng(3)
        return [float(sensor.measure(None, rng)) for _ in values]  # type: ignore[arg-type]

    whole, broken = read([5.0, 5.0, 5.0]), read([5.0, -99.0, 5.0])
    assert broken == [whole[0], -99.0, whole[2]]


def test_bad_sensors_are_refused() -> None:
    zero = lambda world: 0.0  # noqa: E731
    with pytest.raises(UserError, match=r"limits \(1\.0, 0\.0\)"):
        Sensor("a", "m", zero, limits=(1.0, 0.0))
    with pytest.raises(UserError, match="noise nan"):
        Sensor("a", "m", zero, noise=math.nan)
    with pytest.raises(UserError, match="invalid reading 1"):
        Sensor("a", "m", zero, limits=(0.0, 2.0), invalid=1.0)
    with pytest.raises(UserError, match="share a name"):
        SensorSuite([*STANDARD, STANDARD[0]])
    with pytest.raises(UserError, match="no_such"):
        SensorSuite(STANDARD, noise={"no_such": 1.0})
    with World(Road(find_track("oval"))) as world:
        world.reset(seed=0)
        with pytest.raises(UserError, match=r"declares shape \(3,\)"):
            Sensor("a", "m", zero, shape=(3,)).measure(world)


def _straight(road: Road) -> float:
    """Start of the longest straight, and a bit."""
    straight = np.where(road.track.curvature0 == 0.0, road.track.length, 0.0)
    return float(road.track.s0[int(np.argmax(straight))]) + 5.0
