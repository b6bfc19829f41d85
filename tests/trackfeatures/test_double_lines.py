"""Distances to a double line are measured to the line that bounds the car's lane."""

import numpy as np
import pytest

import trackfeatures as tf

GAP = 0.3
# Three lanes of 3.4 m. The second of the four markings is a double line with a gap of 0.3 m.
OFFSETS = ((0.0, 0.0), (GAP / 2, -GAP / 2), (0.0, 0.0), (0.0, 0.0))
WIDTH = 3.4


def distances(to_middle: float) -> list[float | None]:
    found = tf.measure(to_middle, 0.0, 0.0, 0.0, 3, WIDTH, OFFSETS)
    return list(found.distances.values())


def test_the_lanes_beside_a_double_line_are_narrower() -> None:
    # The left lane's centre is at 3.4 m; its right line is at 1.7 + 0.15 m.
    assert distances(3.4) == pytest.approx([-1.7, 1.55, None, None, None])
    # The middle lane extends from 1.55 m to -1.7 m.
    assert distances(0.0) == pytest.approx([-1.55, 1.7, None, None, None])
    assert distances(-3.4) == pytest.approx([-1.7, 1.7, None, None, None])


def test_on_a_double_line_the_side_of_the_car_decides() -> None:
    # The car is 0.4 m left of the double line's centre (1.7 m): 0.25 m from the left lane's line.
    ml, mr, l, m, r = distances(2.1)
    assert (ml, mr) == (None, None)
    assert (l, m, r) == pytest.approx((2.1 - 5.1, 0.25, 2.1 + 1.7))
    # The car is 0.4 m right of the double line's centre, so 0.25 m from the middle lane's line.
    l, m, r = distances(1.3)[2:]
    assert (l, m, r) == pytest.approx((1.3 - 5.1, -0.25, 1.3 + 1.7))


def test_next_to_a_double_line_the_line_of_the_lane_between_counts() -> None:
    # On the third marking (-1.7 m). The middle lane is on its left and ends at 1.55 m.
    l, m, r = distances(-1.6)[2:]
    assert (l, m, r) == pytest.approx((-1.6 - 1.55, 0.1, -1.6 + 5.1))


def test_single_lines_are_measured_as_without_offsets() -> None:
    single = ((0.0, 0.0),) * 4
    for y in np.linspace(-7.5, 7.5, 301).tolist():
        assert tf.measure(y, 0.1, 0.0, 0.0, 3, WIDTH, single) == tf.measure(
            y, 0.1, 0.0, 0.0, 3, WIDTH
        )
