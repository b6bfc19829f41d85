"""Untrusted datasets: no name in them leads to a folder outside that is written or emptied."""

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from datagen.execution.merge import merge
from datagen.planning.plan import RoundPlan
from datagen.recording import Dataset
from datagen.recording.errors import DatasetError
from datagen.recording.folder import (
    RoundState,
    discard_partial,
    discard_partials,
    partial_path,
    read_states,
    round_path,
    state_path,
)
from datagen.recording.round_metadata import RoundHeader
from datagen.recording.split_report import SplitConfig, make_split
from datagen.recording.splits import read_split, split_path
from tests.datagen.commands import make_small_plan
from trackfeatures.names import BadName

WAYS_OUT = ["../../precious", "..", ".", "", "a/b", "/tmp/driverview-no-such", "a\0b"]


@pytest.fixture
def precious(tmp_path: Path) -> Path:
    """A file that belongs to no dataset, two folders above `.partial/`."""
    kept = tmp_path / "precious" / "file"
    kept.parent.mkdir()
    kept.write_text("mine")
    return kept


@pytest.mark.parametrize("name", WAYS_OUT)
def test_no_split_leaves_its_folder(dataset: Path, name: str) -> None:
    before = sorted(dataset.parent.rglob("*"))
    with pytest.raises(BadName, match="the split name is"):
        make_split(dataset, name, SplitConfig("round", 0.5, 0, with_recovered=False))
    with pytest.raises(BadName, match="the split name is"):
        Dataset.open(dataset, name)
    assert sorted(dataset.parent.rglob("*")) == before


@pytest.mark.parametrize("name", ["../../precious", "PATH"])
def test_merge_deletes_nothing_that_a_plan_names(tmp_path: Path, precious: Path, name: str) -> None:
    plan = make_small_plan(2, 10).as_json()
    plan["rounds"][0]["id"] = str(precious.parent) if name == "PATH" else name
    shard, out = tmp_path / "shard", tmp_path / "out"
    (shard / "state").mkdir(parents=True)
    (out / ".partial").mkdir(parents=True)
    for folder in (shard, out):
        (folder / "plan.json").write_text(json.dumps(plan))
    with pytest.raises(DatasetError, match="the round id is"):
        merge([shard], out)
    assert precious.read_text() == "mine"


@pytest.mark.parametrize("name", WAYS_OUT)
def test_no_path_of_a_round_leaves_its_folder(tmp_path: Path, precious: Path, name: str) -> None:
    folder = tmp_path / "dataset"
    (folder / ".partial" / "other").mkdir(parents=True)
    for place in (round_path, state_path, partial_path, discard_partial):
        with pytest.raises(BadName):
            place(folder, name)
    with pytest.raises(BadName):
        discard_partials(folder, [name])
    assert precious.read_text() == "mine"
    assert (folder / ".partial" / "other").is_dir()


def test_unfinished_rounds_behind_a_link_are_not_deleted(tmp_path: Path, precious: Path) -> None:
    folder = tmp_path / "dataset"
    folder.mkdir()
    (folder / ".partial").symlink_to(tmp_path)
    for place in (partial_path, discard_partial):
        with pytest.raises(DatasetError, match="is a link"):
            place(folder, "precious")
    assert precious.read_text() == "mine"


@pytest.mark.parametrize(
    "changed",
    [{"id": "../x"}, {"file": "../../etc/passwd"}, {"file": "/etc/passwd"}, {"file": "rounds/b"}],
)
def test_the_state_of_a_round_names_its_own_file(
    dataset: Path, tmp_path: Path, changed: dict[str, str]
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(dataset, folder)
    states = read_states(folder)
    state = states[min(states)]
    path = state_path(folder, state.id)
    path.write_text(json.dumps(asdict(state) | changed))
    with pytest.raises(DatasetError, match="is no round state"):
        RoundState.read(path)


def test_plan_split_and_metadata_are_checked_when_they_are_read(
    dataset: Path, tmp_path: Path
) -> None:
    entry = make_small_plan(1, 10).as_json()["rounds"][0]
    assert RoundPlan.from_json(entry).id == entry["id"]
    with pytest.raises(BadName):
        RoundPlan.from_json(entry | {"id": "../x"})
    split = json.loads(split_path(dataset).read_text())
    for side in ("train", "recovered"):
        (path := tmp_path / "split.json").write_text(json.dumps(split | {side: ["../x"]}))
        with pytest.raises(DatasetError, match="the round id is"):
            read_split(path)
    header = RoundHeader("a", 1, "oval", "", 1, 4.0, 0, "centre", ("clear",), 50.0)
    header.validate()
    with pytest.raises(BadName):
        replace(header, id="../x").validate()
