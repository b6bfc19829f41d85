"""Charts: positions in SVG coordinates (0 to 1000, y down)."""

import math

import numpy as np
import pytest

from runtime.svg_charts import Axis, Line, Plot, line_plot, log_ticks, reliability_diagram, ticks
from tests.mtlnet.page import Page

NAN = math.nan
X = np.array([0.0, 10.0, 20.0, 30.0])


def points_of(path: str) -> list[list[float]]:
    """The points of an SVG path."""
    pairs = path.replace("M", " ").replace("L", " ").replace("Z", " ").split()
    return [[float(v) for v in pair.split(",")] for pair in pairs]


def test_axes_map_values_to_coordinates() -> None:
    assert [Axis(0, 10)(v) for v in (0, 5, 10)] == [0, 500, 1000]
    assert [Axis(10, 0)(v) for v in (0, 5, 10)] == [1000, 500, 0]
    placed = [Axis(0.01, 100, log=True)(v) for v in (0.01, 0.1, 1, 100)]
    assert placed == pytest.approx([0, 250, 500, 1000])
    assert Axis(3, 3)(3) == 0


def test_ticks_are_round() -> None:
    assert ticks(0, 1) == [0, 0.2, 0.4, 0.6, 0.8, 1]
    assert ticks(-1.1, 2.3) == [-1, 0, 1, 2]
    assert ticks(0, 0) == []
    assert log_ticks(0.015, 0.3) == [0.02, 0.05, 0.1, 0.2]
    assert log_ticks(1e-6, 2.0) == [1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0]
    rng = np.random.default_rng(0)
    for low, wide in zip(rng.normal(0, 100, 300), 10 ** rng.uniform(-4, 4, 300), strict=True):
        found = ticks(low, low + wide)
        assert 3 <= len(found) <= 8
        assert low <= found[0] <= found[-1] <= low + wide


def test_a_line_is_drawn_where_its_values_are() -> None:
    page = Page(
        line_plot(Plot("offset (m)", [Line("predicted", X, np.array([0, 1, NAN, 1]))], "m driven"))
    )
    (line,) = page.all("path", "predicted")
    # The margin is 6 %, so y is drawn from -0.06 to 1.06. NaN interrupts the line.
    assert line.attributes["d"] == "M0.0,946.4L333.3,53.6M1000.0,53.6"
    grid = [path.attributes["d"] for path in page.all("path", "grid")]
    assert grid[0] == "M0,946.4H1000"
    up = {e.text: e.attributes["style"] for e in page.all("span", "y")}
    assert (up["0"], up["1"]) == ("top:94.6%", "top:5.4%")
    across = {e.text: e.attributes["style"] for e in page.all("span", "x")}
    assert across == {"0": "left:0.0%", "10": "left:33.3%", "20": "left:66.7%", "30": "left:100.0%"}
    assert page.all("span", "unit")[0].text == "m driven"
    assert page.all("figcaption")[0].text == "offset (m)"


def test_a_band_is_drawn_behind_its_line_and_cut_off_at_the_edge() -> None:
    y = np.array([0.0, 1.0, NAN, 1.0])
    page = Page(line_plot(Plot("t", [Line("predicted", X, y, band=(y - 0.05, y + 9.0))])))
    paths = [e.attributes["class"] for e in page.all("path") if not e.has_class("grid")]
    assert paths == ["band", "predicted"]
    rings = page.all("path", "band")[0].attributes["d"].split("Z")
    assert [points_of(ring) for ring in rings if ring] == [
        [[0, 0], [333.3, 0], [333.3, 98.2], [0, 991.1]],  # from the edge 0 to y - 0.05
        [[1000, 0], [1000, 98.2]],
    ]


def test_intervals_are_shaded() -> None:
    shaded = [(0.0, 10.0), (15.0, 30.0)]
    page = Page(line_plot(Plot("t", [Line("truth", X, X)], shaded=shaded)))
    boxes = [(e.attributes["x"], e.attributes["width"]) for e in page.all("rect", "shade")]
    assert boxes == [("0.0", "333.3"), ("500.0", "500.0")]


def test_labelled_lines_on_a_logarithmic_axis() -> None:
    y = np.array([1.0, 0.1, 0.01, 0.001])
    named = Line("curve", X, y, "MTL <1>", "#123456", band=(y, y * 10))
    level = Line("level", np.array([0.0, 40.0]), np.full(2, 0.1), "alone", "#654321")
    page = Page(line_plot(Plot("loss", [named, level], "iterations", log=True)))
    (curve,) = page.all("path", "curve")
    points = points_of(curve.attributes["d"])
    assert [x for x, _ in points] == [0, 250, 500, 750]
    assert np.diff([y for _, y in points]) == pytest.approx(
        np.full(3, points[1][1] - points[0][1]), abs=0.2
    )
    assert curve.attributes["style"] == "stroke:#123456"
    (band,) = page.all("path", "band")
    assert band.attributes["style"] == "fill:#123456"
    ring = points_of(band.attributes["d"])
    assert ring[1][1] == points[0][1]  # ten times 0.1 is 1: the axis covers the band
    height = points_of(page.all("path", "level")[0].attributes["d"])
    assert [y for _, y in height] == [points[1][1]] * 2
    assert [e.text for e in page.all("span") if "p" in e.inside] == ["MTL <1>", "alone"]


def test_a_plot_without_lines_is_a_note() -> None:
    page = Page(line_plot(Plot("later & more", [], log=True)))
    assert [e.text for e in page.all("p")] == ["not yet"]
    assert page.all("figcaption")[0].text == "later & more"
    assert (
        Page(line_plot(Plot("t", [Line("predicted", X, np.full(4, NAN))])))
        .all("path", "predicted")[0]
        .attributes["d"]
        == ""
    )


def test_correct_standard_deviations_lie_on_the_diagonal() -> None:
    predicted = np.array([0.01, 0.02, 0.08])
    page = Page(reliability_diagram("ml (m)", predicted, predicted * [1, 1, 2]))
    dots = [points_of(e.attributes["d"].removesuffix("h0"))[0] for e in page.all("path", "dot")]
    assert [x + y for x, y in dots[:2]] == pytest.approx([1000, 1000], abs=0.2)
    assert sum(dots[2]) < 950  # an error of twice the prediction is above the diagonal
    # Axis from 0.008 (0.8 times the smallest value) to 0.2 (1.25 times the largest).
    share = math.log(0.01 / 0.008) / math.log(0.2 / 0.008)
    assert dots[0][0] == pytest.approx(1000 * share, abs=0.1)
    assert page.all("span", "x")[0].text == "0.008"
    assert page.all("span", "x")[1].text == "0.2"
