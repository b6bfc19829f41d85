"""Of a double line the line nearer to the car's lane counts."""

import numpy as np
import pytest

import trackfeatures as tf

GAP = 0.3
# Three lanes of 3.4 m; the second of four markings is a double line, 0.3 m from line to line.
OFFSETS = ((0.0, 0.0), (GAP / 2, -GAP / 2), (0.0, 0.0), (0.0, 0.0))
WIDTH = 3.4


def distances(to_middle: float) -> list[float | None]:
    found = tf.measure(to_middle, 0.0, 0.0, 0.0, 3, WIDTH, OFFSETS)
    return list(found.distances.values())


def test_the_lanes_beside_a_double_line_are_narrower() -> None:
    # The left lane's centre is 3.4 m left of the road's, its right line 0.15 m left of 1.7 m.
    assert distances(3.4) == pytest.approx([-1.7, 1.55, None, None, None])
    # The middle lane: from 1.55 to -1.7.
    assert distances(0.0) == pytest.approx([-1.55, 1.7, None, None, None])
    assert distances(-3.4) == pytest.approx([-1.7, 1.7, None, None, None])


def test_on_a_double_line_the_side_of_the_car_decides() -> None:
    # 0.4 m left of the marking's place (1.7): in the left lane, its line 0.25 m to the right.
    ml, mr, l, m, r = distances(2.1)
    assert (ml, mr) == (None, None)
    assert (l, m, r) == pytest.approx((2.1 - 5.1, 0.25, 2.1 + 1.7))
    # As far to its right: the other line, 0.25 m to the left.
    l, m, r = distances(1.3)[2:]
    assert (l, m, r) == pytest.approx((1.3 - 5.1, -0.25, 1.3 + 1.7))


def test_next_to_a_double_line_the_line_of_the_lane_between_counts() -> None:
    # On the third marking (-1.7): to its left lies the middle lane, bounded by 1.55.
    l, m, r = distances(-1.6)[2:]
    assert (l, m, r) == pytest.approx((-1.6 - 1.55, 0.1, -1.6 + 5.1))


def test_single_lines_are_measured_as_without_offsets() -> None:
    single = ((0.0, 0.0),) * 4
    for y in np.linspace(-7.5, 7.5, 301).tolist():
        assert tf.measure(y, 0.1, 0.0, 0.0, 3, WIDTH, single) == tf.measure(
            y, 0.1, 0.0, 0.0, 3, WIDTH
        )
