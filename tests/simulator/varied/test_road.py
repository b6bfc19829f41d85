"""Varied roads for commands and environments."""

from pathlib import Path

import cv2
import gymnasium
import numpy as np
import pytest
import typer.testing

import simulator.env  # noqa: F401  # registers the environments
from simulator.camera import snapshot
from simulator.cli import app
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.varied.carriageway import Carriageway, camera_heights
from simulator.varied.road import make_road
from trackfeatures.errors import UserError

OVAL = find_track("oval")


def test_the_kind_of_roads_is_asked_for_by_name() -> None:
    assert make_road(OVAL, 2, None) == Road(OVAL, 2)
    assert make_road(OVAL, 2, 3.5) == Road(OVAL, 2, 3.5)
    varied = make_road(OVAL, 2, None, "varied", 7)
    assert varied == Road.varied(OVAL, Carriageway.drawn(7, 2))
    assert varied != make_road(OVAL, 2, None, "varied", 8)
    half = varied.lane_width
    assert varied.asphalt == tuple(half + s for s in Carriageway.drawn(7, 2).shoulders_m)


@pytest.mark.parametrize(
    ("roads", "width", "lanes", "said"),
    [
        ("wild", None, 1, "unknown roads 'wild'; choose paper, varied"),
        ("varied", 3.5, 1, "a lane width of 3.5 m asked for on varied roads"),
        ("varied", None, 4, "a road of 4 lanes"),
        ("paper", 2.6, 1, "lane width 2.6 m is out of range; give 2.7 to 4.5 m"),
    ],
)
def test_impossible_roads_are_refused(
    roads: str, width: float | None, lanes: int, said: str
) -> None:
    with pytest.raises(UserError, match=said):
        make_road(OVAL, lanes, width, roads)


def test_a_road_refuses_the_carriageway_of_another() -> None:
    with pytest.raises(UserError, match="a road of 1 lanes of 4 m has a carriageway of 2 lanes"):
        Road(OVAL, 1, 4.0, Carriageway.drawn(0, 2))


def test_the_heights_that_a_lane_allows() -> None:
    """1.2 w / h lies in 2.75 to 4.4 m, h in 0.9 to 2.2 m."""
    assert camera_heights(3.6) == pytest.approx((1.2 * 3.6 / 4.4, 1.2 * 3.6 / 2.75))
    assert camera_heights(2.8)[0] == 0.9
    assert camera_heights(4.3) == pytest.approx((1.17273, 1.87636), abs=1e-5)


def test_an_environment_drives_on_a_varied_road() -> None:
    env = gymnasium.make("driverview/LateralControl-v0", track="oval", roads="varied", road_seed=3)
    info = env.reset(seed=0)[1]
    wide = Carriageway.drawn(3, 1).lane_width_m
    assert info["features"]["mr"] - info["features"]["ml"] == pytest.approx(wide)


def test_a_snapshot_shows_a_varied_road(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(snapshot, "DRIVER_VIEWS", 2)
    sheets = {}
    for roads in ("paper", "varied"):
        out = tmp_path / f"{roads}.png"
        run = typer.testing.CliRunner().invoke(
            app, ["snapshot", "oval", "--light", "clear", "--roads", roads, "--out", str(out)]
        )
        assert run.exit_code == 0
        sheets[roads] = np.asarray(cv2.imread(str(out)))
    assert sheets["paper"].shape == sheets["varied"].shape
    assert np.mean(sheets["paper"] != sheets["varied"]) > 0.1
