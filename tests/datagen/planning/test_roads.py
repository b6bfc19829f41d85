"""`--roads`: the paper's roads are unchanged; varied roads are drawn, stored and read back."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from datagen.cli import app
from datagen.execution.collect import PLAN_FILE, initialise_folder, require_matching_folder
from datagen.planning import plan as plan_module
from datagen.planning.config import CollectConfig
from datagen.planning.plan import Plan, RoundPlan
from datagen.planning.planner import make_plan
from datagen.planning.tracks import choose_tracks
from datagen.recorder.record import record_round, scenery
from datagen.recording.mcap.index import open_round
from simulator.camera.core.context import graphics
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.varied.look import RoadLook
from trackfeatures.errors import UserError

BEFORE: dict[str, Any] = json.loads(Path(__file__).with_name("paper_roads.json").read_text())
"""Stored from the last commit without varied roads: hashes of plans, and of the images and labels
of rounds as drawn by the renderer that the file names."""
TRACKS = ("highway", "town", "gravel-valley")


def config(**options: Any) -> CollectConfig:
    values = {"rounds": 3, "frames": 24, "seed": 5, "stretch": 1, "scenes": 4, **options}
    return CollectConfig(tracks=choose_tracks(TRACKS, None), **values)


@pytest.fixture(autouse=True)
def _version_of_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Set the program's version of that commit, which is part of a plan's hash."""
    monkeypatch.setattr(plan_module, "version", lambda name: "0.2.0")


def test_plans_of_the_papers_roads_keep_their_hash(tmp_path: Path) -> None:
    plan = make_plan(config())
    assert plan.hash == BEFORE["plan_hash"]
    jittered = make_plan(
        config(rounds=5, frames=30, seed=1, stretch=0, scenes=0, jitter_camera=True)
    )
    assert jittered.hash == BEFORE["jittered_plan_hash"]
    # A plan from before varied roads has no option for roads; it can be resumed.
    initialise_folder(tmp_path, plan)
    written = json.loads((tmp_path / PLAN_FILE).read_text())
    assert "roads" not in written["wanted"]
    assert all("varied" not in entry for entry in written["rounds"])
    require_matching_folder(tmp_path, plan)


@pytest.mark.slow
def test_the_papers_roads_are_recorded_as_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan_module, "version", lambda name: "0")
    drawn_by = graphics()
    if f"{drawn_by.renderer}, {drawn_by.context.info['GL_VERSION']}" != BEFORE["renderer"]:
        pytest.skip("another renderer")
    path = tmp_path / "round.mcap"
    plan = make_plan(config())
    record_round(plan.rounds[1], plan.hash, path, None)
    # The hash of the round's images and labels. It differs on a processor without AVX-512, whose
    # hash was stored later, at 453de30.
    expected = (BEFORE["contents"][1], BEFORE["content_without_avx512"])
    assert open_round(path).result.content_hash in expected


def test_varied_roads_are_drawn_for_each_round_and_scene() -> None:
    plan = make_plan(config(rounds=40, roads="varied"))
    assert plan.hash == make_plan(config(rounds=40, roads="varied")).hash
    widths = np.array([entry.lane_width_m for entry in plan.rounds])
    assert len(np.unique(widths)) > 36
    assert widths.min() < 3.0
    assert widths.max() > 4.1
    for entry in plan.rounds:
        assert entry.varied is not None
        road = entry.varied.carriageway
        assert len(entry.varied.scenes) == len(set(entry.varied.scenes)) == 4
        assert entry.camera.height_above_road_m == pytest.approx(road.camera_height_m, abs=1e-9)
        assert replace(entry.camera, z=entry.nominal_camera.z) == entry.nominal_camera
        assert RoundPlan.from_json(json.loads(json.dumps(entry.as_dict()))) == entry


def test_the_hash_holds_what_was_drawn() -> None:
    plan = make_plan(config(roads="varied"))
    first = plan.rounds[0]
    assert first.varied is not None
    scenes = (replace(first.varied.scenes[0], paint=RoadLook().paint), *first.varied.scenes[1:])
    other = replace(first, varied=replace(first.varied, scenes=scenes))
    assert Plan(plan.config, (other, *plan.rounds[1:])).hash != plan.hash


def test_another_kind_of_roads_does_not_resume(tmp_path: Path) -> None:
    initialise_folder(tmp_path, make_plan(config(roads="varied")))
    with pytest.raises(UserError, match="roads: varied in its plan, now paper"):
        require_matching_folder(tmp_path, make_plan(config()))


def test_the_command_takes_the_kind_of_roads() -> None:
    command = ["collect", "--dry-run", "--json", "--rounds", "3", "--tracks", "oval"]
    runner = CliRunner()
    plans = {
        roads: json.loads(runner.invoke(app, [*command, "--roads", roads]).stdout)
        for roads in ("paper", "varied")
    }
    assert [entry["lane_width_m"] for entry in plans["paper"]["rounds"]] == [4.0] * 3
    assert len({entry["lane_width_m"] for entry in plans["varied"]["rounds"]}) == 3
    assert plans["varied"]["wanted"]["roads"] == "varied"


def test_unknown_roads_are_refused() -> None:
    with pytest.raises(UserError, match="unknown roads 'wild'; choose paper, varied"):
        config(roads="wild")


def double(entry: RoundPlan) -> bool:
    """Whether the road of a round has a double line between two lanes."""
    assert entry.varied is not None
    return any(len(marking.lines) > 1 for marking in entry.varied.carriageway.markings[1:-1])


def test_a_varied_round_holds_what_it_was_drawn_with(tmp_path: Path) -> None:
    entry = next(
        e for e in make_plan(config(rounds=9, frames=4, roads="varied")).rounds if double(e)
    )
    path = tmp_path / "round.mcap"
    record_round(entry, "", path, None)
    header = open_round(path).header
    assert header.varied == json.loads(json.dumps(entry.as_dict()["varied"]))
    assert header.label_camera == entry.camera
    assert entry.varied is not None
    road = Road.varied(find_track(entry.track), entry.varied.carriageway)
    assert any(left != right for left, right in road.line_offsets)
    assert header.line_offsets == road.line_offsets
    assert scenery(entry, 2)[2] == entry.varied.scenes[2]
