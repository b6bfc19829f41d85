"""Traffic: no collisions, speeds within their limits, determinism, placement."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.track.geometry import Track
from simulator.track.pieces import Piece
from simulator.track.road import Road
from simulator.traffic.traffic import (
    DESIRED_KMH,
    EGO_CAR_SIZE,
    LATERAL_ACCELERATION,
    TRAFFIC_CAR_SIZE,
    Traffic,
)
from tests.simulator.track.track_samples import build
from trackfeatures.errors import UserError

DT = 0.05


def stadium(straight: float = 300.0, radius: float = 40.0, hill: float = 6.0) -> Track:
    """Two straights, one up and one down, joined by banked half circles to the left."""
    bend = math.pi * radius
    pieces = [
        Piece(straight, 0.0, 0.0, 0.0, hill, hill),
        Piece(bend, 1 / radius, hill, hill, hill - 1.0, hill + 1.0),
        Piece(straight, 0.0, hill - 1.0, hill + 1.0, 0.0, 0.0),
        Piece(bend, 1 / radius, 0.0, 0.0, 0.0, 0.0),
    ]
    return build(pieces, width=12.0)


def corners(poses: NDArray[np.float64], size: tuple[float, ...]) -> NDArray[np.float64]:
    """(n, 4, 2) corners of the boxes seen from above."""
    half = 0.5 * np.array([size[0], size[1]])
    local = half * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    cos, sin = np.cos(poses[:, 5]), np.sin(poses[:, 5])
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    placed: NDArray[np.float64] = poses[:, None, :2] + np.einsum("nij,kj->nki", turn, local)
    return placed


def apart(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Separating-axis test of two convex quadrangles (4, 2)."""
    edges = np.concatenate([np.diff(a[:3], axis=0), np.diff(b[:3], axis=0)])
    normals = np.stack([-edges[:, 1], edges[:, 0]], -1)
    on_a, on_b = normals @ a.T, normals @ b.T
    gap = (on_a.max(1) < on_b.min(1)) | (on_b.max(1) < on_a.min(1))
    return bool(gap.any())


def run(lanes: int, seed: int, steps: int, ego_speed: float = 14.0) -> tuple[Traffic, list[Any]]:
    """Traffic with an ego car in the rightmost lane; returns samples of all positions."""
    road = Road(stadium(), lanes=lanes, lane_width=3.2)
    traffic = Traffic(road, 12, np.random.default_rng(seed), ego_s=500.0)
    ego_y = float(0.5 * (road.markings_y[-1] + road.markings_y[-2]))
    ego_s, places = 500.0, []
    for step in range(steps):
        leader = traffic.leader(ego_s, ego_y)
        speed = ego_speed if leader is None else min(ego_speed, max(leader[0] - 3.0, 0.0))
        ego_s += speed * DT
        traffic.step(DT, ego_s, ego_y, speed)
        if step % 4 == 0:
            places.append((traffic.poses(), traffic.speed, traffic.to_middle, ego_s, ego_y))
    return traffic, places


@pytest.mark.parametrize("lanes", [1, 2, 3])
def test_twelve_cars_never_touch_in_three_minutes(lanes: int) -> None:
    traffic, places = run(lanes, seed=lanes, steps=3600)
    track = traffic.road.track
    moved = 0.0
    for poses, speed, _, ego_s, ego_y in places:
        at = track.at(ego_s, ego_y)
        ego = np.array([[at.x, at.y, at.z, 0.0, 0.0, at.heading]], dtype=np.float64)
        # Only near cars can touch: a cheap filter before the exact test.
        boxes = np.concatenate([corners(poses, TRAFFIC_CAR_SIZE), corners(ego, EGO_CAR_SIZE)])
        middles = boxes.mean(axis=1)
        for i, j in itertools.combinations(range(13), 2):
            if np.hypot(*(middles[i] - middles[j])) < 6.0:
                assert apart(boxes[i], boxes[j]), f"cars {i} and {j} overlap"
        moved += float(speed.mean()) * 4 * DT
    changes = float(np.abs(np.diff([y for _, _, y, _, _ in places], axis=0)).sum())
    assert moved > 180 * 5  # they do drive: more than 5 m/s on average
    assert (changes > 3.0) == (lanes > 1)  # and change lanes where there are lanes


def test_same_seed_is_bit_identical() -> None:
    first, _ = run(3, seed=5, steps=600)
    second, _ = run(3, seed=5, steps=600)
    other, _ = run(3, seed=6, steps=600)
    assert first.poses().tobytes() == second.poses().tobytes()
    assert first.poses().tobytes() != other.poses().tobytes()


def test_speeds_stay_in_range_and_below_the_curve_limit() -> None:
    traffic, places = run(2, seed=3, steps=2000)
    assert np.all(traffic.desired_speed * 3.6 >= DESIRED_KMH[0])
    assert np.all(traffic.desired_speed * 3.6 <= DESIRED_KMH[1])
    before = places[0][1]
    for poses, speed, to_middle, _, _ in places[1:]:
        assert np.all(speed <= traffic.desired_speed + 0.01)
        assert np.all(np.abs(speed - before) <= 9.0 * 4 * DT + 1e-9)
        before = speed
        for row, v, y in zip(poses, speed, to_middle, strict=True):
            s, _ = traffic.road.track.project(row[0], row[1])
            k = traffic.road.track.curvature(s)
            assert v * v * abs(k / (1 - k * y)) <= LATERAL_ACCELERATION * 1.02


def test_lateral_motion_is_smooth_and_yaw_follows_it() -> None:
    road = Road(stadium(), lanes=3, lane_width=3.2)
    traffic = Traffic(road, 12, np.random.default_rng(4))
    checked = 0
    for _ in range(1200):
        before_y, before_s = traffic.to_middle, traffic.s
        traffic.step(DT, 0.0, 0.0, 0.0)
        sideways = traffic.to_middle - before_y
        forward = (traffic.s - before_s) % road.track.length_m
        assert np.all(np.abs(sideways) / DT < 2.5)
        headings = road.track.at(traffic.s).heading
        angle = (traffic.poses()[:, 5] - headings + np.pi) % (2 * np.pi) - np.pi
        straight = (road.track.at(traffic.s).curvature == 0) & (forward > 0.3)
        slopes = np.arctan2(sideways[straight], forward[straight])
        np.testing.assert_allclose(angle[straight], slopes, atol=0.02)
        checked += int(np.count_nonzero(np.abs(sideways) > 0.01))
    assert checked > 50


def test_car_poses_lie_on_the_road_plane() -> None:
    road = Road(stadium(), lanes=2)
    traffic = Traffic(road, 12, np.random.default_rng(1))
    s, y = traffic.s, traffic.to_middle
    at = road.track.at(s, y)
    np.testing.assert_allclose(traffic.poses()[:, :3], np.stack([at.x, at.y, at.z], -1), atol=1e-9)
    # A metre forward and a metre left along the tilted body axes stay on the plane.
    for row, s_i, y_i in zip(traffic.poses(), s, y, strict=True):
        roll, pitch, yaw = row[3:]
        if road.track.curvature(s_i) != 0.0 or abs(s_i - 300.0) < 2.0:
            continue
        forward_z = -math.sin(pitch)
        left_z = math.cos(pitch) * math.sin(roll)
        step = 0.01
        rise = float(road.track.at(s_i + step, y_i).z - road.track.at(s_i, y_i).z)
        across = float(road.track.at(s_i, y_i + step).z - road.track.at(s_i, y_i).z)
        assert forward_z / math.cos(pitch) == pytest.approx(rise / step, abs=1e-6)
        assert left_z == pytest.approx(across / step, abs=2e-2)
        assert yaw == pytest.approx(float(road.track.at(s_i).heading))


def test_no_car_starts_near_the_ego_car() -> None:
    road = Road(stadium(), lanes=3)
    for seed in range(20):
        traffic = Traffic(road, 12, np.random.default_rng(seed), ego_s=10.0)
        gaps = np.abs((traffic.s - 10.0 + 400.0) % road.track.length_m - 400.0)
        assert gaps.min() >= 25.0 + 0.5 * (TRAFFIC_CAR_SIZE[0] + EGO_CAR_SIZE[0]) - 1e-9


def test_cars_stop_behind_an_ego_car_at_rest() -> None:
    road = Road(stadium(), lanes=1)
    traffic = Traffic(road, 3, np.random.default_rng(0), ego_s=300.0)
    for _ in range(2400):
        traffic.step(DT, 300.0, 0.0, 0.0)
    assert np.all(traffic.speed < 0.05)
    behind = np.sort((300.0 - traffic.s) % road.track.length_m)
    assert behind[0] - 0.5 * (TRAFFIC_CAR_SIZE[0] + EGO_CAR_SIZE[0]) == pytest.approx(2.5, abs=0.7)


def test_leader_is_the_nearest_car_in_the_same_lane() -> None:
    road = Road(stadium(), lanes=2)
    traffic = Traffic(road, 8, np.random.default_rng(2), ego_s=0.0)
    for lane_y in (2.0, -2.0):
        rows = np.flatnonzero(np.abs(traffic.to_middle - lane_y) < 0.1)
        first = rows[np.argmin(traffic.s[rows])]
        found = traffic.leader(0.0, lane_y)
        assert found is not None
        gap = traffic.s[first] - 0.5 * (TRAFFIC_CAR_SIZE[0] + EGO_CAR_SIZE[0])
        assert found[0] == pytest.approx(gap)
        assert found[1] == pytest.approx(traffic.speed[first])
    assert not traffic.has_room(float(traffic.s[first]), -2.0, 10.0)
    assert Traffic(road, 0, np.random.default_rng(0)).leader(0.0, 0.0) is None


@pytest.mark.parametrize("count", [-1, 13, 500])
def test_more_cars_than_fit_are_refused(count: int) -> None:
    with pytest.raises(UserError, match="ask for fewer"):
        Traffic(Road(stadium(), lanes=3), count, np.random.default_rng(0))


def test_a_short_track_has_room_for_fewer_cars() -> None:
    tiny = Road(stadium(straight=20.0, radius=25.0, hill=0.0), lanes=1)
    with pytest.raises(UserError, match="takes 0 to 8"):
        Traffic(tiny, 12, np.random.default_rng(0))
    assert Traffic(tiny, 8, np.random.default_rng(0)).count == 8
