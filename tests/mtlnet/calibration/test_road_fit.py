"""The fit of one picture's segments: closed form."""

import numpy as np
import pytest

from mtlnet.calibration.road_fit import Lines, fit_road
from mtlnet.calibration.vanishing_point import find_vanishing_point


def segments(x0: float, y0: float, bend: float, slopes: list[float]) -> Lines:
    below = np.tile(np.linspace(0.08, 0.5, 7), len(slopes))
    a = np.repeat(slopes, 7)
    return Lines(
        x0 + a * below + bend / below,
        y0 + below,
        a - bend / below**2,
        np.full(len(a), 0.01),
        np.full(len(a), 0.03),
    )


@pytest.mark.parametrize("bend", [0.0, 0.001, -0.0015])
def test_a_road_is_found_exactly(bend: float) -> None:
    fit = fit_road(segments(0.03, -0.05, bend, [-1.4, 1.6, 4.6]), 0.01, -0.02)
    assert fit is not None
    # The prior of the bend is 0.004: the estimate is slightly too small.
    assert fit.x0 == pytest.approx(0.03, abs=4e-4)
    assert fit.y0 == pytest.approx(-0.05, abs=4e-4)
    assert fit.bend == pytest.approx(bend, abs=1e-4)
    assert fit.slopes == pytest.approx((-1.4, 1.6, 4.6), abs=0.01)


def test_segments_of_other_things_do_not_matter() -> None:
    road, rng = segments(0.03, -0.05, 0.0, [-1.4, 1.6]), np.random.default_rng(1)
    other = Lines(
        rng.uniform(-0.4, 0.4, 8), rng.uniform(0.05, 0.4, 8), rng.uniform(-0.5, 0.5, 8),
        np.full(8, 0.01), np.full(8, 0.02),
    )  # fmt: skip
    both = Lines(*(np.concatenate([getattr(road, n), getattr(other, n)]) for n in road.__slots__))
    fit = fit_road(both, 0.01, -0.02)
    assert fit is not None
    assert (fit.x0, fit.y0) == pytest.approx((0.03, -0.05), abs=2e-3)


def test_one_marking_is_not_enough() -> None:
    assert fit_road(segments(0.03, -0.05, 0.0, [1.6]), 0.01, -0.02) is None


def test_segments_turn_with_the_camera() -> None:
    lines = segments(0.03, -0.05, 0.0, [-1.4, 1.6])
    back = lines.turned(0.03).turned(-0.03)
    np.testing.assert_allclose(back.slope, lines.slope, atol=1e-12)
    np.testing.assert_allclose(back.x, lines.x, atol=1e-12)
    fit = fit_road(lines.turned(0.03), 0.03, -0.05)
    assert fit is not None
    c, s = np.cos(0.03), np.sin(0.03)
    assert (fit.x0, fit.y0) == pytest.approx((0.03 * c + 0.05 * s, 0.03 * s - 0.05 * c), abs=1e-6)


def test_the_mode_of_many_pictures_is_the_vanishing_point() -> None:
    straight = [segments(0.05, -0.08, 0.0, [-1.4, 1.6])] * 10
    bent = [segments(0.05 + 0.02 * k, -0.08, 0.003 * k, [-1.4, 1.6]) for k in range(-4, 5)]
    found = find_vanishing_point(straight + bent)
    assert found == pytest.approx((0.05, -0.08), abs=0.005)
    assert find_vanishing_point([]) is None
