"""Twelve cars drive for ten minutes, with the ego car moving or parked, without a collision."""

import math

import numpy as np
import pytest

from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.traffic.car_table import centre_line_advance
from tests.simulator.traffic_audit import (
    TrafficViolation,
    audit_traffic,
    first_overlap,
    rectangles_overlap,
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("track", "lanes", "parked"),
    [
        pytest.param("town", 1, False, marks=pytest.mark.extended),
        ("circuit", 2, False),
        ("oval", 3, True),
    ],
)
def test_ten_minutes_of_traffic_without_a_violation(track: str, lanes: int, parked: bool) -> None:
    seen = audit_traffic(Road(find_track(track), lanes), 600.0, parked=parked)
    assert seen.steps == 12_000
    assert (seen.lane_changes > 3) == (lanes > 1)
    # Cars in the lane of a parked car stand behind it; all other cars drive.
    assert seen.mean_speed_kmh > (5.0 if parked else 30.0)
    assert seen.own_laps == 0 if parked else seen.own_laps > 1


@pytest.mark.contacts
def test_the_audit_detects_a_collision(monkeypatch: pytest.MonkeyPatch) -> None:
    """With leaders ignored, traffic hits a parked car, which the audit reports."""
    monkeypatch.setattr("simulator.traffic.traffic.Traffic._update_ego", lambda *_: None)
    with pytest.raises(TrafficViolation, match=r"hit traffic|overlap"):
        audit_traffic(Road(find_track("town"), 1), 300.0, parked=True)


def corners(box: np.ndarray) -> np.ndarray:
    """(n, 2) points all round the edge of a box (x, y, yaw, length, width)."""
    side = np.linspace(-0.5, 0.5, 201)
    edge = np.concatenate(
        [np.column_stack((side, np.full(201, end))) for end in (-0.5, 0.5)]
        + [np.column_stack((np.full(201, end), side)) for end in (-0.5, 0.5)]
    )
    along, across = edge[:, 0] * box[3], edge[:, 1] * box[4]
    cos, sin = math.cos(box[2]), math.sin(box[2])
    return np.column_stack(
        (box[0] + along * cos - across * sin, box[1] + along * sin + across * cos)
    )


def test_box_overlap_agrees_with_sampled_points() -> None:
    rng, seen = np.random.default_rng(0), []
    for _ in range(400):
        a = np.array([0.0, 0.0, rng.uniform(-4, 4), 4.5, 1.9])
        b = np.array([*rng.uniform(-5, 5, 2), rng.uniform(-4, 4), 4.4, 1.8])
        points = corners(b) - a[:2]
        cos, sin = math.cos(a[2]), math.sin(a[2])
        along, across = points @ (cos, sin), points @ (-sin, cos)
        inside = bool(np.any((abs(along) < 2.25) & (abs(across) < 0.95)))
        # Edges are dense: only a corner that just pokes in could be missed.
        deep = bool(np.any((abs(along) < 2.2) & (abs(across) < 0.9)))
        assert rectangles_overlap(a, b) >= deep
        assert rectangles_overlap(b, a) == rectangles_overlap(a, b)
        assert inside or not rectangles_overlap(a, b) or not deep
        seen.append(rectangles_overlap(a, b))
        assert (first_overlap(np.array([a, b])) == (0, 1)) == rectangles_overlap(a, b)
    assert 50 < sum(seen) < 350


def test_centre_line_advance_across_a_joint_of_two_bends() -> None:
    """s advances by distance / (1 - k y), with the curvature k of the piece on each side."""
    track = find_track("town")
    table = track.arrays()
    joint = int(np.argmax(np.abs(np.diff(track.curvature0)))) + 1
    s = float(track.s0[joint]) - 0.4
    for y in (-3.0, 0.0, 3.0):
        before, after = (1.0 - track.curvature0[joint - 1 : joint + 1] * y).tolist()
        way = 0.4 * before + 0.3 * after
        assert centre_line_advance(table, s, y, way) == pytest.approx(0.7, abs=1e-9)
        assert centre_line_advance(table, s, y, 0.0) == 0.0
    round_once = float(track.length_m)
    assert centre_line_advance(table, s, 0.0, round_once) == pytest.approx(round_once, abs=1e-6)
