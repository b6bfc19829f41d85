"""Sensors: range beams against brute force and by hand, units, noise, a sensor of the user's."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.sensors.beams import BEAM_ANGLES, RANGE_M, shorten_at_boxes, track_beams
from simulator.sensors.sensor import Sensor, SensorSuite
from simulator.sensors.standard import STANDARD, read_range, read_track_range
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world import Command, World
from trackfeatures.errors import UserError


def brute_force(road: Road, x: float, y: float, yaw: float) -> NDArray[np.float64]:
    """Where each beam first cuts the polylines of both edges, sampled every 5 cm."""
    s = np.arange(0.0, road.track.length_m, 0.05)
    nearest = np.full(len(BEAM_ANGLES), RANGE_M)
    for side in (road.edge, -road.edge):
        edge = road.track.at(s, side)
        start = np.column_stack((edge.x - x, edge.y - y))
        end = np.roll(start, -1, axis=0)
        along = end - start
        for i, angle in enumerate(yaw + BEAM_ANGLES):
            ray = np.array([math.cos(angle), math.sin(angle)])
            across = ray[0] * along[:, 1] - ray[1] * along[:, 0]
            with np.errstate(divide="ignore", invalid="ignore"):
                distance = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / across
                place = (start[:, 0] * ray[1] - start[:, 1] * ray[0]) / across
            hit = (distance > 0.0) & (place >= 0.0) & (place < 1.0)
            if np.any(hit):
                nearest[i] = min(nearest[i], float(distance[hit].min()))
    return nearest


@pytest.mark.parametrize(("name", "lanes"), [("circuit", 1), ("mountain-pass", 3)])
def test_range_beams_agree_with_brute_force(name: str, lanes: int) -> None:
    road = Road(find_track(name), lanes)
    rng = np.random.default_rng(4)
    for _ in range(12):
        s = float(rng.uniform(0.0, road.track.length_m))
        d = float(rng.uniform(-0.95, 0.95) * road.edge)
        pose = road.track.at(s, d)
        x, y, yaw = float(pose.x), float(pose.y), float(pose.heading) + float(rng.normal(0, 0.3))
        beams = track_beams(road.track.arrays(), -1, x, y, yaw, BEAM_ANGLES, road.edge)
        np.testing.assert_allclose(beams, brute_force(road, x, y, yaw), atol=0.02)


def test_beams_across_a_straight_are_its_sides() -> None:
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
    table = road.track.arrays()
    beams = track_beams(table, -1, float(pose.x), float(pose.y), 0.0, BEAM_ANGLES, road.edge)
    np.testing.assert_array_equal(beams, -1.0)


def test_a_beam_ends_at_a_box() -> None:
    beams = np.full(len(BEAM_ANGLES), RANGE_M)
    box = np.array([[20.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 10.0, 0.0, 0.0, 0.0, math.pi / 2]])
    shorten_at_boxes(beams, 0.0, 0.0, 0.0, BEAM_ANGLES, box, 4.4, 1.8)
    assert beams[9] == pytest.approx(20.0 - 2.2)  # straight ahead
    assert beams[0] == pytest.approx(10.0 - 2.2)  # to the left, the box stands crosswise
    assert beams[-1] == RANGE_M
    assert beams[8] == RANGE_M  # 10 deg passes 3.1 m to the left of the box ahead


def test_traffic_is_seen_by_the_second_set_only() -> None:
    with World(Road(find_track("oval")), traffic=1) as world:
        s = _straight(world.road)
        world.reset(seed=0, s=s)
        ahead = 0.0
        for _ in range(1500):
            wheel = 2.0 * world.state.angle - world.state.to_middle
            world.step(Command(steer=min(max(wheel, -1.0), 1.0), throttle=0.4))
            gap = world.traffic.leader(world.state.s, world.state.to_middle)
            # Within 10 m, road and cars are as good as straight.
            if gap is not None and gap[0] < 10.0:
                ahead = gap[0] + 4.52 / 2  # the beams start at the centre of gravity
                break
        assert ahead > 0.0
        assert read_range(world)[9] == pytest.approx(ahead, abs=0.5)
        assert read_track_range(world)[9] > ahead + 1.0


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


def test_a_user_adds_a_sensor_in_one_line() -> None:
    slip = Sensor("side_slip", "rad", lambda world: math.atan2(world.state.vy, world.state.vx))
    suite = SensorSuite([*STANDARD, slip])
    with World(Road(find_track("oval"))) as world:
        world.reset(seed=0, speed=10.0)
        assert suite.read(world)["side_slip"] == pytest.approx(0.0, abs=1e-12)


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


def test_noise_keeps_to_the_range_meters_limits_and_to_its_sign_of_no_track() -> None:
    with World(Road(find_track("oval"))) as world:
        world.reset(seed=0, s=_straight(world.road))
        suite = SensorSuite(STANDARD, seed=7, noise={"range": 300.0})
        seen = np.array([suite.read(world)["range"] for _ in range(50)])
        assert (seen.min(), seen.max()) == (0.0, 200.0)
        while not world.step(Command(steer=1.0, throttle=1.0)).off_track:
            pass
        np.testing.assert_array_equal(suite.read(world)["range"], np.full(19, -1.0))


def test_bad_sensors_are_refused() -> None:
    with pytest.raises(UserError, match=r"limits \(1\.0, 0\.0\)"):
        Sensor("x", "m", lambda _: 0.0, limits=(1.0, 0.0))
    with pytest.raises(UserError, match="share a name"):
        SensorSuite([*STANDARD, STANDARD[0]])
    with pytest.raises(UserError, match="no_such"):
        SensorSuite(STANDARD, noise={"no_such": 1.0})
    with pytest.raises(UserError, match="noise -1"):
        Sensor("x", "m", lambda _: 0.0, noise=-1.0)


def _straight(road: Road) -> float:
    """Start of the longest straight, and a bit."""
    straight = np.where(road.track.curvature0 == 0.0, road.track.length, 0.0)
    return float(road.track.s0[int(np.argmax(straight))]) + 5.0
