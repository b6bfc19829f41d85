"""The cells of `labels.csv`: the lane of a row, and the distances that are accepted."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest

import trackfeatures as tf
from mtlnet.data.labels_file import (
    MARKING_LIMITS_M,
    check_cells,
    lane_cells,
    lane_sides,
    read_cells,
)
from trackfeatures.definitions import LANE_WIDTH_LIMITS_M, MARKINGS, lane_offset
from trackfeatures.errors import UserError

REST = {"file": "a.png", "angle": "0", "heading": "?"}


@pytest.mark.parametrize("m", [-1.1, -0.3, 0.0, 0.3, 1.1])
def test_the_lane_of_a_row_is_the_lane_of_the_definitions(m: float) -> None:
    """The middle of the two sides is the offset to the nearest lane, whichever cells are given."""
    own = [(None, None), (-1.6, 2.0)] if abs(m) > 0.5 else [(None, None)]
    for (ml, mr), l, r in product(own, (m - 3.6, None), (m + 3.4, None)):
        row = dict(zip(MARKINGS, (ml, mr, l, m, r), strict=True))
        sides = lane_sides(row)
        assert (None if sides is None else sum(sides) / 2) == lane_offset(**row), row


def decoded(row: dict[str, float]) -> dict[str, bool]:
    """Whether each distance of a row is present after it was coded as a float32 label."""
    values = np.array([[row.get(name, np.nan) for name in MARKINGS]], np.float32)
    present = np.isfinite(tf.decode(tf.encode(values, [0.0]))[0][0])
    return dict(zip(MARKINGS, present.tolist(), strict=True))


@pytest.mark.parametrize(
    "row",
    [
        {"ml": -2.8, "mr": 2.8}, {"ml": -3.0, "mr": 3.0}, {"ml": -5.5, "mr": 2.0},
        {"ml": -3.0, "mr": 2.51}, {"m": 2.75}, {"m": -1.0, "l": -6.9}, {"m": 1.0, "r": 6.8},
    ],
)  # fmt: skip
def test_a_distance_that_the_coding_reads_as_absent_is_refused(row: dict[str, float]) -> None:
    assert not all(decoded(row)[name] for name in row)
    cells = {**REST, **{name: f"{value:g}" for name, value in row.items()}}
    with pytest.raises(UserError, match=r"is .* m.*; it must be"):
        check_cells(cells)


def test_an_accepted_distance_stays_present_in_the_coding() -> None:
    accepted = [
        {"m": 0.0, name: limit} for name in ("l", "m", "r") for limit in MARKING_LIMITS_M[name]
    ]
    accepted += [{"ml": -2.7, "mr": 2.798}, {"ml": -4.998, "mr": 0.5}, {"ml": -0.5, "mr": 4.998}]
    for row in accepted:
        check_cells({**REST, **{name: f"{value:g}" for name, value in row.items()}})
        assert all(decoded(row)[name] for name in row), row
        for name, value in row.items():
            assert tf.RANGES[name].lo <= value <= tf.RANGES[name].hi  # the coding does not clip it


def test_every_lane_of_a_real_road_is_accepted() -> None:
    """From 2 m outside the lane's left marking to 2 m outside its right marking."""
    for width in (*LANE_WIDTH_LIMITS_M, 3.5):
        for ml in np.arange(-2.0 - width, 2.0, 0.05):
            check_cells({**REST, **lane_cells(float(ml), float(ml) + width)})


def test_a_file_has_one_name(tmp_path: Path) -> None:
    table = tmp_path / "labels.csv"
    head, cells = "file,ml,mr,l,m,r,angle,heading\n", ",-1,2.5,?,?,?,0,?\n"
    names = {"./b.jpg": "b.jpg", "c//./d.jpg": "c/d.jpg", "../e.jpg": "../e.jpg", "": ""}
    table.write_text(head + "".join(name + cells for name in names))
    assert [row["file"] for _, row in read_cells(table)] == list(names.values())
    table.write_text(f"{head}b.jpg{cells}./b.jpg{cells}")
    with pytest.raises(UserError, match=r"line 3: b\.jpg stands in line 2 already"):
        read_cells(table)
