"""Real collections: equal bytes in two runs, resuming, refused options."""

import itertools
import json
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import trackfeatures as tf
from datagen.cli.collect import Lights
from datagen.execution.collect import collect, initialise_folder, require_matching_folder
from datagen.execution.merge import merge
from datagen.planning.config import CollectConfig, TrackChoice, all_lights
from datagen.planning.plan import Plan, RoundPlan
from datagen.planning.planner import make_plan
from datagen.planning.tracks import choose_tracks
from datagen.recorder.job import RoundDone
from datagen.recorder.record import open_simulation
from datagen.recording import Dataset
from datagen.recording.errors import DatasetError
from datagen.recording.folder import read_states
from datagen.recording.integrity.verify import verify
from simulator.track.catalogue import OWN_TRACKS
from tests.datagen.commands import (
    SHORT,
    attempted,
    datagen,
    datagen_here,
    make_jobs,
    make_small_plan,
)
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError


def test_a_collected_dataset_passes_verify_and_can_be_read(collected: Path) -> None:
    report = verify(collected, "deep")
    assert report.ok, report.problems
    dataset = Dataset.open(collected)
    assert {info.split for info in dataset.rounds} == {"train", "test"}
    frames = dataset.select("all")
    images = frames.read_batch(range(60), np.empty((60, 210, 280, 3), np.uint8))
    # The picture shows a road: it is neither black nor of one colour, and the sky is brighter.
    assert images.std(axis=(1, 2, 3)).min() > 10.0
    labels = frames.labels
    place = labels.to_middle[labels.round == 0]
    assert 0.0 < np.abs(np.diff(place)).max() < 0.3
    assert labels.speed.min() > 5.0


def test_verify_and_info_as_commands(
    collected: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    done = datagen_here("verify", collected, "--level", "full", "--json")
    report = json.loads(done.stdout)
    assert done.returncode == 0
    info = json.loads(datagen_here("info", collected, "--json").stdout)
    assert (report["ok"], report["rounds"], report["frames"]) == (True, 2, 60)
    assert report["problems"] == []
    assert report["content_hash"] == info["content_hash"]
    assert (info["rounds"], info["by_lanes"]) == (2, {"1": 30, "2": 30})
    assert "always predicting the mean" in datagen_here("info", collected).stdout
    nothing = datagen_here("verify", tmp_path / "nothing", "--json")
    assert nothing.returncode == 1
    assert not json.loads(nothing.stdout)["ok"]
    assert "no level 'slow'" in refused("verify", collected, "--level", "slow")


def test_the_same_plan_gives_the_same_bytes_with_another_number_of_workers(
    collected: Path, tmp_path: Path
) -> None:
    done = datagen_here("collect", *SHORT, "--out", tmp_path / "again", "--workers", "1")
    assert done.returncode == 0, done.stderr
    for path in sorted((collected / "rounds").iterdir()):
        assert path.read_bytes() == (tmp_path / "again" / "rounds" / path.name).read_bytes()


@pytest.mark.usefixtures("recorded_here")
def test_a_finished_dataset_is_left_alone_and_a_lost_round_made_again(collected: Path) -> None:
    lost = collected / "rounds" / "round-001.mcap"
    kept = collected / "rounds" / "round-000.mcap"
    before, written = lost.read_bytes(), kept.stat().st_mtime_ns
    lost.unlink()
    done = datagen_here("collect", *SHORT, "--out", collected, "--workers", "1", "--json")
    assert json.loads(done.stdout)["recorded_frames"] == 30
    assert lost.read_bytes() == before
    assert kept.stat().st_mtime_ns == written
    done = datagen_here("collect", *SHORT, "--out", collected, "--json")
    assert (done.returncode, json.loads(done.stdout)["recorded_frames"]) == (0, 0)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--seed", "9"], "seed: 0 in its plan, now 9"),
        (["--tracks", "no-such-track"], "no track 'no-such-track'"),
        (["--lanes", "1,5"], "a road of 5 lanes is not supported"),
        (["--lanes", "one"], "--lanes is 'one'"),
        (["--workers", "-1"], "-1 workers"),
        (["--tracks-dir", "/no/such/folder"], "no folder /no/such/folder"),
        (["--executor", "slurm"], "no executor 'slurm'; choose local, ray"),
        (["--shard", "3/2"], "--shard is '3/2'"),
        (["--split", "later"], "no split 'later'"),
        (["--split", "unseen"], "track circuit is one of those to train on"),
        (["--jitter-camera"], "jitter_camera: False in its plan, now True"),
        (["--scenes", "4"], "4 scenes a round asked for, but the scenery never changes; give --st"),
        (["--scenes", "-1"], "-1 scenes a round"),
        (["--stretch", "-1"], "a stretch of -1 frames"),
        (["--frequency", "7"], "7 Hz does not divide"),
    ],
)
def test_impossible_options_are_refused_with_a_one_line_error(
    collected: Path, refused: Callable[..., str], args: list[str], message: str
) -> None:
    before = {path: path.stat().st_mtime_ns for path in collected.rglob("*")}
    assert message in refused("collect", *SHORT, "--out", collected, *args)
    assert {path: path.stat().st_mtime_ns for path in collected.rglob("*")} == before


def test_a_folder_that_is_no_dataset_is_not_changed(
    tmp_path: Path, refused: Callable[..., str]
) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    assert "is not a dataset" in refused("collect", *SHORT, "--out", tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]
    assert "is a file" in refused("collect", *SHORT, "--out", tmp_path / "thesis.tex")


def test_a_folder_with_empty_dataset_subfolders_is_accepted(tmp_path: Path) -> None:
    plan = make_small_plan(1, 10)
    (tmp_path / "rounds").mkdir()
    (tmp_path / "state").mkdir()
    (tmp_path / "plan.json.partial").write_text('{"rou')
    require_matching_folder(tmp_path, plan)
    (tmp_path / "rounds" / "somebody.mcap").write_text("else's")
    with pytest.raises(DatasetError, match="is not a dataset"):
        collect(plan, tmp_path, workers=1)


def test_a_dataset_of_other_definitions_is_refused(tmp_path: Path) -> None:
    plan = make_small_plan(1, 10)
    (tmp_path / "plan.json").write_text(json.dumps({**plan.as_json(), "definitions": "0-old"}))
    with pytest.raises(tf.DefinitionsMismatch, match="0-old"):
        collect(plan, tmp_path, workers=1)


def test_files_outside_the_plan_are_reported_before_recording(
    collected: Path, refused: Callable[..., str]
) -> None:
    """Any MCAP file in `rounds/` would be read as a round of the dataset."""
    foreign = collected / "rounds" / "drive-2024.mcap"
    foreign.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    try:
        message = refused("collect", *SHORT, "--out", collected)
        assert message.startswith(f"error: {foreign} is no round of this plan; move it out of")
    finally:
        foreign.unlink()
    assert verify(collected, "full").ok


def test_a_dataset_of_another_program_version_is_not_continued(tmp_path: Path) -> None:
    plan = make_small_plan(1, 10)
    content = {**plan.as_json(), "program": "driverview 0.0.1", "hash": "0" * 64}
    (tmp_path / "plan.json").write_text(json.dumps(content))
    with pytest.raises(DatasetError, match=r"made by driverview 0\.0\.1, this is driverview "):
        collect(plan, tmp_path, workers=1)


@pytest.mark.parametrize(
    ("pattern", "text"),
    [
        ("^look = .*$", 'look = "town"'),
        ("^kerbs = .*$", "kerbs = false"),
        ("^surface = .*$", 'surface = "gravel"'),
    ],
)
def test_a_dataset_is_not_continued_on_a_track_of_another_look_paint_or_surface(
    tmp_path: Path, pattern: str, text: str
) -> None:
    track, plans = tmp_path / "mine.toml", list[Plan]()
    before = (OWN_TRACKS / "circuit.toml").read_text()
    for content in (before, re.sub(pattern, text, before, flags=re.M)):
        assert content != before or not plans
        track.write_text(content)
        tracks = choose_tracks((str(track),), None)
        plans.append(make_plan(CollectConfig(2, 10, tracks=tracks)))
    begun, changed = plans
    assert begun.hash == changed.hash  # as in earlier versions
    with (
        pytest.raises(UserError, match="is not the one this dataset was planned with"),
        open_simulation(begun.rounds[0], None),
    ):
        pass
    folders = tmp_path / "begun", tmp_path / "changed"
    for folder, plan in zip(folders, plans, strict=True):
        folder.mkdir()
        initialise_folder(folder, plan)
        require_matching_folder(folder, plan)
    with pytest.raises(DatasetError, match="begun with another surface, scenery or paint of the"):
        require_matching_folder(folders[0], changed)
    with pytest.raises(DatasetError, match="were recorded with another surface, scenery or paint"):
        merge(folders, tmp_path / "both")
    for entry in (earlier := begun.as_json())["rounds"]:
        del entry["picture_hash"]
    (folders[0] / "plan.json").write_text(json.dumps(earlier))  # as earlier versions wrote it
    require_matching_folder(folders[0], changed)


def test_the_refusal_of_a_changed_geometry_names_the_track(tmp_path: Path) -> None:
    def plan(content: str) -> Plan:
        tracks = TrackChoice("mine", content, content), TrackChoice("other", "cc", "cc")
        return make_plan(CollectConfig(rounds=4, frames=20, tracks=tracks))

    initialise_folder(tmp_path, plan("aa"))
    with pytest.raises(DatasetError, match="begun with another geometry of the track mine; rest"):
        require_matching_folder(tmp_path, plan("bb"))
    require_matching_folder(tmp_path, plan("aa"))


def test_a_plan_with_other_rounds_of_the_same_options_names_the_first_difference(
    tmp_path: Path,
) -> None:
    plan = make_small_plan(3, 20)
    initialise_folder(tmp_path, plan)
    entries = list(plan.rounds)
    entries[1:] = [replace(entry, frames=99) for entry in entries[1:]]
    words = re.escape("another plan (frames of round-001: 20 in its plan, now 99)")
    with pytest.raises(DatasetError, match=words):
        require_matching_folder(tmp_path, replace(plan, rounds=tuple(entries)))
    with pytest.raises(DatasetError, match=r"another plan \(3 rounds in its plan, now 2\)"):
        require_matching_folder(tmp_path, replace(plan, rounds=plan.rounds[:2]))


def test_without_a_renderer_the_error_says_what_to_install(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    environment = os.environ | {"__EGL_VENDOR_LIBRARY_FILENAMES": str(tmp_path / "nothing.json")}
    done = datagen("collect", *SHORT, "--out", folder, env=environment)
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("error: "))
    assert "no OpenGL 3.3 through EGL on this machine" in line
    assert "apt-get install libegl1" in line
    assert "Traceback" not in done.stderr
    assert not list(folder.glob("rounds/*"))


def test_a_clock_that_jumps_changes_nothing(
    collected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jumps = itertools.cycle([0.0, 4e9, 1e9])
    monkeypatch.setattr("time.time", lambda: next(jumps))
    job = make_jobs(tmp_path, rounds=1, frames=30)[0]
    wanted = json.loads((collected / "plan.json").read_text())
    entry = RoundPlan.from_json(wanted["rounds"][0])
    done = attempted(replace(job, plan=entry, plan_hash=wanted["hash"]))
    assert isinstance(done, RoundDone)
    assert read_states(collected)["round-000"] == done.state


def test_a_dry_run_prints_the_plan_and_touches_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    args = ["collect", "--rounds", "6", "--frames", "500", "--tracks", "circuit,town"]
    args += ["--seed", "3", "--out", str(folder), "--dry-run"]
    text = datagen_here(*args).stdout
    assert [f"round-00{n}" in text for n in range(7)] == [True] * 6 + [False]
    assert "road ahead" in text
    assert "6 rounds of 500 frames" in text
    plan = json.loads(datagen_here(*args, "--json").stdout)
    assert [entry["id"] for entry in plan["rounds"]] == [f"round-00{n}" for n in range(6)]
    assert len(plan["hash"]) == 64
    for shares in plan["expected_classes"].values():
        assert sum(shares.values()) == pytest.approx(1.0, abs=1e-3)
    assert min(plan["expected_classes"]["all"].values()) >= 0.15
    assert list(tmp_path.iterdir()) == []
    oval = datagen_here("collect", "--tracks", "oval", "--dry-run").stdout
    assert "note: right will be 0% of the train frames and 0% of the test frames" in oval


@pytest.mark.usefixtures("recorded_here")
def test_rounds_of_an_unseen_track_with_jittered_cameras_are_a_dataset_of_their_own(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "data"
    args = ["--rounds", "2", "--frames", "10", "--split", "unseen", "--jitter-camera"]
    args += ["--lights", "clear,fog", "--tracks", "coast", "--workers", "1"]
    done = datagen_here("collect", *args, "--out", folder)
    assert done.returncode == 0, done.stderr
    dataset = Dataset.open(folder)
    assert {(info.split, info.track) for info in dataset.rounds} == {("unseen", "coast")}
    assert len(dataset.select("unseen")) == 20
    with pytest.raises(DatasetError, match="none for train"):
        dataset.select("train")
    cameras = [index.header.camera for index in dataset.indexes]
    assert cameras[0] != cameras[1] != dataset.camera == CameraParameters()
    assert verify(folder, "deep").ok
    info = datagen_here("info", folder).stdout
    assert "unseen: 20 frames" in info


def test_the_help_of_lights_names_every_light() -> None:
    (option,) = get_args(Lights)[1:]
    assert f"from: {', '.join(all_lights())};" in option.help
