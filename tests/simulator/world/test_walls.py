"""Walls stand along the whole road, tight bends included, and never cross it."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.track.road import Road
from simulator.world.walls import PANEL, Panel, Walls
from tests.simulator.track.track_samples import flat_stadium


def inner_face(panel: Panel) -> NDArray[np.float64]:
    """(7, 2) points along the panel's face towards the road."""
    along = np.linspace(-0.5, 0.5, 7)[:, None] * PANEL[0]
    ahead = np.array([math.cos(panel.yaw), math.sin(panel.yaw)])
    points: NDArray[np.float64] = np.array(panel.face) + along * ahead
    return points


@pytest.mark.parametrize("radius", [8.0, 10.0, 11.0, 20.0, 60.0])
@pytest.mark.parametrize("side", [1, -1])
def test_walls_follow_every_bend(radius: float, side: int) -> None:
    track = flat_stadium(40.0, radius, width=9.0)
    road = Road(track)
    walls = Walls(road)
    for s in np.arange(0.0, track.length_m, 0.7):
        panel = walls.panel(float(s), side * (road.wall_offset - 2.0), 3.5)
        if panel is None:
            # Within a metre of the middle of the bend there is no room for a wall.
            assert side > 0
            assert radius - road.wall_offset <= 1.0
            continue
        face = inner_face(panel)
        offsets = [track.project(float(x), float(y))[1] * side for x, y in face]
        assert offsets[3] == pytest.approx(road.wall_offset, abs=1e-6)
        # The panel is flat where the wall is bent, but never reaches over the road.
        assert min(offsets) > road.edge
        reach = 0.5 * PANEL[0]
        sagitta = reach**2 / (2.0 * (radius - side * road.wall_offset))
        assert np.ptp(offsets) < 1.2 * sagitta + 1e-6 or radius < 12.0


def test_no_panel_for_a_car_far_from_the_wall_or_behind_it() -> None:
    walls = Walls(Road(flat_stadium(200.0, 60.0, width=9.0)))
    assert walls.panel(100.0, walls.offset - 3.6, 3.5) is None
    assert walls.panel(100.0, walls.offset - 3.4, 3.5) is not None
    assert walls.panel(100.0, walls.offset + 0.1, 3.5) is None


def test_a_wall_is_open_where_another_part_of_the_track_lies() -> None:
    # A hairpin with straights 12 m apart: walls 8.5 m out would stand on the other straight.
    walls = Walls(Road(flat_stadium(200.0, 6.0, width=12.0)))
    assert walls.panel(100.0, 6.5, 3.5) is None
    outer = walls.panel(100.0, -6.5, 3.5)
    assert outer is not None
    assert (outer.x, outer.yaw) == pytest.approx((100.0, 0.0))
    assert outer.y == pytest.approx(-walls.offset - 1.5)
    assert walls.panel(100.0, -3.0, 3.5) is None  # too far
    assert walls.panel(100.0, -9.0, 3.5) is None  # behind it
