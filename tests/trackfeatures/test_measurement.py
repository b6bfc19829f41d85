"""Measured features: signs, limits of the two marking systems, a brute-force geometric oracle."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import trackfeatures as tf

LANES = st.integers(1, 3)
WIDTHS = st.floats(2.7, 4.5)
OFFSETS = st.floats(-9.0, 9.0)


def measure(to_middle: float, lanes: int, width: float = 4.0) -> tf.TrackFeatures:
    return tf.measure(to_middle, 0.0, 0.0, 0.0, lanes, width)


def test_in_the_middle_of_a_lane_both_markings_are_half_a_lane_width_away() -> None:
    features = measure(0.0, lanes=1)
    assert (features.ml, features.mr) == (-2.0, 2.0)
    assert (features.l, features.m, features.r) == (None, None, None)
    assert features.to_lane_centre == 0.0


def test_left_of_the_centre_the_left_marking_is_nearer() -> None:
    features = measure(0.4, lanes=1)
    assert features.ml == pytest.approx(-1.6)
    assert features.mr == pytest.approx(2.4)
    assert features.to_lane_centre == pytest.approx(0.4)


def test_on_the_divider_of_two_lanes_only_the_on_marking_system_is_active() -> None:
    features = measure(0.2, lanes=2)
    assert (features.ml, features.mr) == (None, None)
    assert features.l == pytest.approx(-3.8)
    assert features.m == pytest.approx(0.2)
    assert features.r == pytest.approx(4.2)
    assert features.to_lane_centre == pytest.approx(-1.8)


@pytest.mark.parametrize(
    ("from_marking", "in_lane", "on_marking"),
    [(0.49, False, True), (0.51, True, True), (1.19, True, True), (1.21, True, False)],
)
def test_both_systems_are_active_between_half_a_metre_and_1_2(
    from_marking: float, in_lane: bool, on_marking: bool
) -> None:
    for side in (-1, 1):
        features = measure(side * from_marking, lanes=2)
        assert (features.ml is not None) == in_lane
        assert (features.m is not None) == on_marking
        if on_marking:
            assert features.m == pytest.approx(side * from_marking)


def test_a_one_lane_road_has_no_neighbour_lane() -> None:
    on_left_marking = measure(1.7, lanes=1)
    assert on_left_marking.m == pytest.approx(-0.3)
    assert on_left_marking.l is None
    assert on_left_marking.r == pytest.approx(3.7)


@pytest.mark.parametrize("side", [-1, 1])
def test_outside_the_road_the_outer_marking_is_measured_up_to_two_metres(side: int) -> None:
    edge = 2 * 4.0 / 2
    seen = measure(side * (edge + 1.99), lanes=2)
    assert seen.m == pytest.approx(side * 1.99)
    assert (seen.l is None) == (side > 0)
    assert (seen.r is None) == (side < 0)
    assert seen.to_lane_centre == pytest.approx(side * 3.99)
    lost = measure(side * (edge + 2.01), lanes=2)
    assert set(lost.distances.values()) == {None}
    assert lost.to_lane_centre is None


@given(LANES, WIDTHS, OFFSETS)
def test_to_lane_centre_is_the_offset_from_the_nearest_lane(
    lanes: int, width: float, to_middle: float
) -> None:
    features = measure(to_middle, lanes, width)
    index = tf.lane_index(to_middle, lanes, width)
    expected = to_middle - tf.lane_centre(index, lanes, width)
    outside = abs(to_middle) - lanes * width / 2
    # Within a rounding error of a marking either lane can be the nearest.
    assume(min(abs(to_middle - tf.marking_offsets(lanes, width))) > 1e-9)
    assume(abs(outside - 2.0) > 1e-9)
    if outside > 2.0:
        assert features.to_lane_centre is None
    else:
        assert features.to_lane_centre == pytest.approx(expected, abs=1e-9)


@given(LANES, WIDTHS, OFFSETS)
def test_mirroring_the_road_swaps_sides(lanes: int, width: float, to_middle: float) -> None:
    assume(min(abs(to_middle - tf.marking_offsets(lanes, width))) > 1e-9)
    here = measure(to_middle, lanes, width)
    there = measure(-to_middle, lanes, width)
    for one, other in (("ml", "mr"), ("l", "r"), ("m", "m")):
        a, b = here.distances[one], there.distances[other]
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            assert a == pytest.approx(-b, abs=1e-9)


@pytest.mark.parametrize(
    ("lanes", "width"),
    [(0, 4.0), (4, 4.0), (2.0, 4.0), (True, 4.0), ("2", 4.0), (2, 2.6), (2, 4.6)],
)
def test_impossible_roads_are_refused(lanes: Any, width: float) -> None:
    with pytest.raises(tf.UserError, match=r"lane"):
        tf.check_lanes(lanes, width)


@dataclass(frozen=True)
class Circle:
    """A ring road around the origin, driven counter-clockwise; s = 0 is at (radius, 0)."""

    radius: float

    def project(self, x: float, y: float) -> tuple[float, float]:
        return math.atan2(y, x) % math.tau * self.radius, self.radius - math.hypot(x, y)

    def heading(self, s: float) -> float:
        return s / self.radius + math.pi / 2

    def curvature(self, s: float) -> float:
        return 1 / self.radius


def oracle(ring: Circle, x: float, y: float, lanes: int, width: float) -> dict[str, float | None]:
    """Distances found by a search over 20,000 points of each marking's circle, without formulas."""
    turn = np.linspace(0, math.tau, 20_000, endpoint=False)
    gaps = []
    for offset in tf.marking_offsets(lanes, width):
        r = ring.radius - offset
        points = np.column_stack([r * np.cos(turn), r * np.sin(turn)])
        gap = float(np.hypot(points[:, 0] - x, points[:, 1] - y).min())
        # The car drives counter-clockwise, so a larger circle is on its right.
        gaps.append(gap if r > math.hypot(x, y) else -gap)
    found: dict[str, float | None] = dict.fromkeys(tf.MARKINGS)
    left = [gap for gap in gaps if gap <= 0]
    right = [gap for gap in gaps if gap > 0]
    if left and right and -max(left) >= 0.5 and min(right) >= 0.5:
        found["ml"], found["mr"] = max(left), min(right)
    nearest = min(range(len(gaps)), key=lambda k: abs(gaps[k]))
    if abs(gaps[nearest]) <= (1.2 if left and right else 2.0):
        found["m"] = gaps[nearest]
        found["l"] = gaps[nearest - 1] if nearest > 0 else None
        found["r"] = gaps[nearest + 1] if nearest < lanes else None
    return found


@given(st.floats(25.0, 200.0), LANES, WIDTHS, OFFSETS, st.floats(-3.0, 3.0), st.floats(-0.5, 0.5))
def test_measured_pose_on_a_ring_road_equals_a_brute_force_search(
    radius: float, lanes: int, width: float, to_middle: float, turn: float, angle: float
) -> None:
    ring = Circle(radius)
    from_marking = min(abs(to_middle - tf.marking_offsets(lanes, width)))
    assume(all(abs(from_marking - limit) > 1e-3 for limit in (0.0, 0.5, 1.2, 2.0)))
    r = radius - to_middle
    x, y = r * math.cos(turn), r * math.sin(turn)
    yaw = turn + math.pi / 2 - angle
    measured = tf.measure_pose(ring, x, y, yaw, lanes, width)
    assert measured.angle == pytest.approx(angle, abs=1e-9)
    expected_class = tf.RoadClass.LEFT if radius <= 170 else tf.RoadClass.STRAIGHT
    assert measured.heading == expected_class
    for name, distance in oracle(ring, x, y, lanes, width).items():
        assert (measured.distances[name] is None) == (distance is None), name
        if distance is not None:
            assert measured.distances[name] == pytest.approx(distance, abs=2e-2), name


def test_angle_is_positive_when_the_car_points_to_the_right() -> None:
    ring = Circle(100.0)
    pointing_right = tf.measure_pose(ring, 100.0, 0.0, math.pi / 2 - 0.1, 1, 4.0)
    assert pointing_right.angle == pytest.approx(0.1)
