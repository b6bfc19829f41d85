"""A split that the user has changed stays when its dataset is collected or merged again."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from datagen.execution.merge import merge
from datagen.recording import Dataset
from datagen.recording.folder import begin_merge, read_states
from datagen.recording.integrity.verify import verify
from datagen.recording.splits import Split, read_split, split_path, write_split
from tests.datagen.commands import ROUNDS, datagen_here, with_recovered

pytestmark = pytest.mark.usefixtures("recorded_here")


def _unfinished(whole: Path, folder: Path) -> Path:
    """A copy of the dataset in which round-002 has never been recorded."""
    shutil.copytree(whole, folder)
    for name in ("rounds/round-002.mcap", "state/round-002.json"):
        (folder / name).unlink()
    return folder


@pytest.mark.parametrize("shard", [[], ["--shard", "1/1"]])
def test_rounds_recorded_after_a_change_of_the_split_are_on_their_planned_side(
    whole: Path, tmp_path: Path, shard: list[str]
) -> None:
    folder = _unfinished(whole, tmp_path / "data")
    assert read_split(split_path(whole)) == Split(("round-001", "round-002"), ("round-000",))
    own = Split(("round-000",), ("round-001",))
    write_split(split_path(folder), own)
    done = datagen_here("collect", *ROUNDS, *shard, "--out", folder, "--json")
    assert (done.returncode, json.loads(done.stdout)["recorded_frames"]) == (0, 20)
    assert read_split(split_path(folder)) == replace(own, train=("round-000", "round-002"))
    assert verify(folder, "full").ok


@pytest.mark.parametrize("own", ["before", "meanwhile"])
def test_a_side_that_the_user_gave_to_an_unrecorded_round_stays(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: str
) -> None:
    folder = _unfinished(whole, tmp_path / "data")
    split = Split(("round-000", "round-001"), ("round-002",))
    if own == "before":
        write_split(split_path(folder), split)
    else:
        monkeypatch.setattr(
            "datagen.execution.collect._remove_leftovers",
            lambda folder, rounds: write_split(split_path(folder), split),
        )
    assert datagen_here("collect", *ROUNDS, "--out", folder).returncode == 0
    assert read_split(split_path(folder)) == split


@pytest.mark.parametrize("left_out", [True, False])
def test_a_split_of_the_users_own_stays_when_collected_again(
    whole: Path, tmp_path: Path, *, left_out: bool
) -> None:
    folder = tmp_path / "data"
    shutil.copytree(whole, folder)
    planned = read_split(split_path(folder))
    swapped = replace(planned, train=planned.test, test=planned.train)
    own = replace(planned, train=planned.train[1:]) if left_out else swapped
    write_split(split_path(folder), own)
    (folder / "rounds" / "round-002.mcap").unlink()  # recorded again
    done = datagen_here("collect", *ROUNDS, "--out", folder, "--json")
    assert done.returncode == 0, done.stderr
    assert read_split(split_path(folder)) == own
    assert Dataset.open(folder).content_hash == json.loads(done.stdout)["content_hash"]


@pytest.mark.parametrize("moved", [("round-000", "round-001", "round-002"), ("round-002",)])
def test_a_round_recorded_again_keeps_its_side_after_an_interruption(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moved: tuple[str, ...]
) -> None:
    folder = tmp_path / "data"
    shutil.copytree(whole, folder)
    planned = read_split(split_path(folder))
    train, test = (
        tuple(
            i for i in (*planned.train, *planned.test) if (planned.side(i) == side) ^ (i in moved)
        )
        for side in ("train", "test")
    )
    own = replace(planned, train=train, test=test)
    write_split(split_path(folder), own)
    (folder / "rounds" / "round-002.mcap").unlink()
    with monkeypatch.context() as patch:
        patch.setattr("datagen.execution.process_pool.ProcessPool.run", _killed)
        assert datagen_here("collect", *ROUNDS, "--out", folder).returncode == 130
    assert len(Dataset.open(folder).rounds) == 2
    done = datagen_here("collect", *ROUNDS, "--out", folder)
    assert done.returncode == 0, done.stderr
    assert {*read_split(split_path(folder)).train} == {*train}
    assert {*read_split(split_path(folder)).test} == {*test}
    assert verify(folder, "full").ok


@pytest.mark.parametrize("killed", ["no", "yes", "earlier version"])
def test_a_split_of_the_users_own_stays_when_more_rounds_are_merged(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, killed: str
) -> None:
    part, out = _unfinished(whole, tmp_path / "part"), tmp_path / "out"
    merge([part], out)
    planned = read_split(split_path(whole))
    before = read_split(split_path(out))
    write_split(split_path(out), replace(before, train=before.test, test=before.train))
    if killed != "no":
        with monkeypatch.context() as patch:
            patch.setattr("datagen.execution.merge._derive", _killed)
            with pytest.raises(KeyboardInterrupt):
                merge([whole], out)
        assert (out / "rounds/round-002.mcap").exists()
    if killed == "earlier version":
        (out / ".merging").write_text("")
    assert merge([whole], out).rounds == 3
    split = read_split(split_path(out))
    assert split.side("round-002") == planned.side("round-002") != ""
    for name in ("round-000", "round-001"):
        assert {split.side(name), planned.side(name)} == {"train", "test"}
    assert verify(out, "full").ok


def test_the_copied_rounds_of_an_interrupted_merge_are_a_dataset(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copied: list[object] = []

    def copy_one(source: Path, target: Path) -> None:
        if copied:
            raise KeyboardInterrupt
        copied.append(target.write_bytes(source.read_bytes()))

    with monkeypatch.context() as patch:
        patch.setattr("datagen.execution.merge.shutil.copyfile", copy_one)
        with pytest.raises(KeyboardInterrupt):
            merge([whole], tmp_path / "out")
    assert len(Dataset.open(tmp_path / "out").rounds) == 1
    assert merge([whole], tmp_path / "out").rounds == 3
    assert read_split(split_path(tmp_path / "out")) == read_split(split_path(whole))
    assert verify(tmp_path / "out", "full").ok


def test_a_half_merged_dataset_is_not_collected(
    whole: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    folder = _unfinished(whole, tmp_path / "data")
    begin_merge(folder, ["round-001"])
    mark = (folder / ".merging").read_bytes()
    assert "running the same `datagen merge` again" in refused("collect", *ROUNDS, "--out", folder)
    assert (folder / ".merging").read_bytes() == mark
    assert list(read_states(folder)) == ["round-000", "round-001"]


@pytest.mark.parametrize("command", ["collect", "merge"])
def test_an_unreadable_split_is_refused_before_any_change(
    whole: Path, tmp_path: Path, refused: Callable[..., str], command: str
) -> None:
    folder = _unfinished(whole, tmp_path / "data")
    text = split_path(folder).read_text().replace("]", ",]", 1)
    split_path(folder).write_text(text)
    words = ROUNDS if command == "collect" else [whole]
    message = refused(command, *words, "--out", folder)
    assert "default.json is no split" in message
    assert "correct the file, or delete it" in message
    assert split_path(folder).read_text() == text
    assert list(read_states(folder)) == ["round-000", "round-001"]
    assert not (folder / ".merging").exists()


def test_an_undamaged_copy_of_a_recovered_round_that_was_left_out_is_on_its_planned_side(
    whole: Path, tmp_path: Path
) -> None:
    folder, _ = with_recovered(whole, tmp_path / "data")
    own = Split(("round-000",), ("round-002",))
    write_split(split_path(folder), own)
    less, _ = with_recovered(whole, tmp_path / "less", kept=0.5)
    assert merge([less], folder).added == 0
    assert read_split(split_path(folder)) == own
    assert merge([whole], folder).added == 1
    assert read_split(split_path(folder)) == replace(own, train=("round-000", "round-001"))
    more, _ = with_recovered(whole, tmp_path / "more")
    write_split(split_path(less), own)
    assert merge([more], less).added == 1  # recovered, too
    assert read_split(split_path(less)) == own


def _killed(*_: object) -> None:
    raise KeyboardInterrupt
