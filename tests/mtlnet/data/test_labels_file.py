"""The cells of `labels.csv`: the lane of a row."""

from itertools import product

import pytest

from mtlnet.data.labels_file import lane_sides
from trackfeatures.definitions import MARKINGS, lane_offset


@pytest.mark.parametrize("m", [-1.1, -0.3, 0.0, 0.3, 1.1])
def test_the_lane_of_a_row_is_the_lane_of_the_definitions(m: float) -> None:
    """The middle of the two sides is the offset to the nearest lane, whichever cells are given."""
    own = [(None, None), (-1.6, 2.0)] if abs(m) > 0.5 else [(None, None)]
    for (ml, mr), l, r in product(own, (m - 3.6, None), (m + 3.4, None)):
        row = dict(zip(MARKINGS, (ml, mr, l, m, r), strict=True))
        sides = lane_sides(row)
        assert (None if sides is None else sum(sides) / 2) == lane_offset(**row), row
