"""The least distance between parts of a course, on courses with known distances."""

import math

import pytest

from simulator.track.layout import Bend, Segment, Straight
from simulator.track.random_roads.clearance import keeps_clear


def bend(radius: float, degrees: float) -> Bend:
    return Bend(radius, math.radians(degrees), 0.0, 0.0, 0.0)


def stadium(radius: float, straight: float) -> list[Segment]:
    """Two straights at twice `radius` from each other."""
    return [Straight(straight, 0.0), bend(radius, 180.0)] * 2


@pytest.mark.parametrize("straight", [40.0, 100.0, 450.0])
def test_parallel_parts_may_be_no_nearer_than_24_m(straight: float) -> None:
    assert keeps_clear(stadium(12.3, straight))
    assert not keeps_clear(stadium(11.9, straight))


@pytest.mark.parametrize(("apart", "clear"), [(20.0, False), (24.6, True), (30.0, True)])
def test_a_dent_may_not_come_near_the_other_side(apart: float, clear: bool) -> None:
    """A rectangle whose upper side dips to `apart` above the lower one."""
    width, height, dip = 400.0, 150.0, 150.0 - apart
    side = (width - 100.0) / 2.0
    course: list[Segment] = [Straight(width, 0.0), bend(15.0, 90.0), Straight(height - 30.0, 0.0)]
    course += [bend(15.0, 90.0), Straight(side - 15.0, 0.0), bend(15.0, 90.0)]
    course += [Straight(dip - 30.0, 0.0), bend(15.0, -90.0), Straight(70.0, 0.0)]
    course += [bend(15.0, -90.0), Straight(dip - 30.0, 0.0), bend(15.0, 90.0)]
    course += [Straight(side - 15.0, 0.0), bend(15.0, 90.0), Straight(height - 30.0, 0.0)]
    assert keeps_clear([*course, bend(15.0, 90.0)]) is clear


def test_a_course_that_crosses_itself_is_not_clear() -> None:
    eight: list[Segment] = [Straight(100.0, 0.0), bend(50.0, 270.0)]
    assert not keeps_clear([*eight, Straight(100.0, 0.0), bend(50.0, -270.0)])
