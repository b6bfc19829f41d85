"""Several collectors on one plan: parallel shards, locks, and merging of folders."""

import errno
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import trackfeatures as tf
from datagen.execution.collect import initialise_folder
from datagen.execution.lock import folder_lock
from datagen.execution.merge import merge
from datagen.planning.config import CollectConfig
from datagen.planning.plan import Shard
from datagen.planning.planner import make_plan
from datagen.planning.tracks import choose_tracks
from datagen.recording import Dataset
from datagen.recording.errors import DatasetError
from datagen.recording.folder import prepare, read_states
from datagen.recording.integrity.verify import verify
from datagen.recording.splits import read_split, split_path
from tests.datagen.commands import ROUNDS, datagen_here, make_small_plan, with_recovered
from trackfeatures.camera import CameraParameters


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((folder / "rounds").iterdir())}


def test_a_shard_is_every_nth_round() -> None:
    rounds = make_small_plan(7, 10).rounds
    parts = [Shard(number, 3).select(rounds) for number in (1, 2, 3)]
    assert [e.id[-1] for e in parts[1]] == ["1", "4"]
    assert sorted(e.id for part in parts for e in part) == [e.id for e in rounds]
    assert Shard.parse("2/3") == Shard(2, 3)


@pytest.mark.parametrize("text", ["0/3", "4/3", "2", "a/b", "1/0", "-1/3"])
def test_invalid_shard_options_are_refused(text: str) -> None:
    with pytest.raises(tf.UserError, match="as 1/4 to 4/4"):
        Shard.parse(text)


@pytest.mark.extended
@pytest.mark.slow
def test_parallel_shards_give_the_same_dataset_as_one_collector(
    whole: Path, tmp_path: Path
) -> None:
    shared = tmp_path / "shared"
    command = [sys.executable, "-m", "datagen", "collect", *ROUNDS, "--out", str(shared), "--json"]
    running = [
        subprocess.Popen(
            [*command, "--shard", f"{number}/2"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        for number in (1, 2)
    ]
    ended = [process.communicate(timeout=600) for process in running]
    assert [process.returncode for process in running] == [0, 0], ended
    results = [json.loads(stdout) for stdout, _ in ended]
    assert [result["rounds"] for result in results] == [2, 1]
    assert files(shared) == files(whole)
    # The last shard to end has written the manifest.
    last = next(result for result in results if result["content_hash"])
    assert last["content_hash"] == Dataset.open(whole).content_hash
    assert (shared / "manifest.json").read_text() == (whole / "manifest.json").read_text()
    assert verify(shared, "full").ok


def test_folders_of_shards_are_merged(
    whole: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    parts = [_without(whole, tmp_path / "one", ("001",)), tmp_path / "two"]
    _without(whole, parts[1], ("000", "002"))
    out = tmp_path / "out"
    merged = merge([parts[0]], out)
    assert (merged.rounds, merged.planned, merged.added) == (2, 3, 2)
    done = datagen_here("merge", *parts, "--out", out, "--json")
    both = json.loads(done.stdout)
    assert (both["rounds"], both["added"], both["frames"]) == (3, 1, 60)
    assert both["content_hash"] == Dataset.open(whole).content_hash
    assert files(out) == files(whole)
    assert (out / "manifest.json").read_text() == (whole / "manifest.json").read_text()
    assert verify(out, "full").ok
    assert not (out / ".partial").exists()


def test_collections_of_another_prefix_and_seed_are_one_plan(tmp_path: Path) -> None:
    tracks = choose_tracks(("oval",), None)
    for seed, prefix in ((1, "a"), (2, "b"), (3, "a")):
        config = CollectConfig(2, 3, seed=seed, prefix=prefix, tracks=tracks)
        prepare(tmp_path / prefix / str(seed))
        plan = json.dumps(make_plan(config).as_json())
        (tmp_path / prefix / str(seed) / "plan.json").write_text(plan)
    with pytest.raises(DatasetError, match="no folder has a finished round"):
        merge([tmp_path / "a" / "1", tmp_path / "b" / "2"], tmp_path / "both")
    entries = json.loads((tmp_path / "both" / "plan.json").read_text())["rounds"]
    assert sorted(entry["id"] for entry in entries) == ["a-000", "a-001", "b-000", "b-001"]
    folders = [tmp_path / "b" / "2", tmp_path / "a" / "1", tmp_path / "a" / "3"]
    with pytest.raises(DatasetError, match=r"a/1 and .*a/3 .*id a-000;.* another --prefix"):
        merge(folders, tmp_path / "same")
    with pytest.raises(DatasetError, match="was begun with other folders"):
        merge(folders[:1], tmp_path / "both")
    with pytest.raises(tf.UserError, match="prefix of the rounds' names"):
        CollectConfig(prefix="../a", tracks=tracks)


def test_merge_refuses_other_cameras_and_copies_nothing(tmp_path: Path) -> None:
    for seed, camera in ((1, CameraParameters()), (2, CameraParameters(fov_y_deg=50.0))):
        config = CollectConfig(
            2, 3, seed=seed, prefix=str(seed), tracks=choose_tracks(("oval",), None), camera=camera
        )
        prepare(tmp_path / str(seed))
        (tmp_path / str(seed) / "plan.json").write_text(json.dumps(make_plan(config).as_json()))
    with pytest.raises(DatasetError, match=r"/1 and .*/2 have different cameras"):
        merge([tmp_path / "1", tmp_path / "2"], tmp_path / "both")
    assert not (tmp_path / "both").exists()
    # A plan that states the same camera with fewer keys and as whole numbers.
    plan = (tmp_path / "1" / "plan.json").read_text().replace('"y": 0.0', '"y": 0')
    (tmp_path / "2" / "plan.json").write_text(plan.replace('"id": "1-', '"id": "2-'))
    entries = json.loads((tmp_path / "2" / "plan.json").read_text())
    for entry in entries["rounds"]:
        entry["seed"] += 1000
        del entry["nominal_camera"]["pitch_deg"]
    (tmp_path / "2" / "plan.json").write_text(json.dumps({**entries, "hash": "0" * 64}))
    with pytest.raises(DatasetError, match="no folder has a finished round"):
        merge([tmp_path / "1", tmp_path / "2"], tmp_path / "both")


def test_merge_on_a_full_disk_names_the_file_that_it_writes(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def copyfile(source: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(source), None, str(target))

    monkeypatch.setattr("shutil.copyfile", copyfile)
    with pytest.raises(OSError, match="No space left") as caught:
        merge([whole], tmp_path / "out")
    assert str(caught.value.filename).startswith(str(tmp_path / "out"))


def test_merge_refuses_folders_of_other_plans_and_damaged_rounds(
    whole: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    new, part = tmp_path / "new", _without(whole, tmp_path / "part", ())
    assert "no folder of `datagen collect`" in refused("merge", tmp_path, "--out", new)
    (other := tmp_path / "other").mkdir()
    plan = json.loads((whole / "plan.json").read_text()) | {"hash": "0" * 64}
    (other / "plan.json").write_text(json.dumps(plan))
    assert "have different plans" in refused("merge", whole, other, "--out", new)
    assert not new.exists()
    damaged = part / "rounds" / "round-001.mcap"
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    assert "is damaged" in refused("merge", part, "--out", new)
    assert list(read_states(new)) == ["round-000"]
    assert not (new / ".partial" / "round-001").exists()
    assert "is not a dataset" in refused("merge", part, "--out", tmp_path / "part" / "rounds")


def _without(whole: Path, folder: Path, numbers: tuple[str, ...]) -> Path:
    """A copy of the dataset without some rounds, as one shard leaves it."""
    shutil.copytree(whole, folder)
    for number in numbers:
        (folder / "rounds" / f"round-{number}.mcap").unlink()
        (folder / "state" / f"round-{number}.json").unlink()
    return folder


def test_two_collectors_of_the_same_rounds_are_refused(tmp_path: Path) -> None:
    with folder_lock(tmp_path, Shard(1, 2)):
        with folder_lock(tmp_path, Shard(2, 2)):
            pass
        for other in (Shard(1, 2), Shard(1, 3), None):
            with (
                pytest.raises(DatasetError, match=r"is being recorded|is writing to"),
                folder_lock(tmp_path, other),
            ):
                pass
    with folder_lock(tmp_path, Shard(1, 3)):
        pass
    with (
        folder_lock(tmp_path, None),
        pytest.raises(DatasetError, match="another `datagen collect`"),
        folder_lock(tmp_path, Shard(1, 2)),
    ):
        pass


def test_a_collector_refuses_a_folder_that_another_process_holds(
    whole: Path, refused: Callable[..., str]
) -> None:
    hold = (
        "import sys, time; from pathlib import Path\n"
        "from datagen.execution.lock import folder_lock\n"
        "with folder_lock(Path(sys.argv[1]), None): print('held', flush=True); time.sleep(300)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", hold, str(whole)], stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        assert "another `datagen collect`" in refused("collect", *ROUNDS, "--out", whole)
        other.kill()
    deadline = time.monotonic() + 120.0
    while datagen_here("collect", *ROUNDS, "--out", whole).returncode:  # the lock ended with it
        assert time.monotonic() < deadline


@pytest.mark.usefixtures("recorded_here")
def test_a_recovered_round_stays_in_a_dataset_that_is_collected_again(
    whole: Path, tmp_path: Path
) -> None:
    folder, saved = with_recovered(whole, tmp_path / "data")
    (folder / "rounds" / "round-002.mcap").unlink()
    done = datagen_here("collect", *ROUNDS, "--out", folder, "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert (result["frames"], result["recorded_frames"]) == (40 + saved, 20)
    assert Dataset.open(folder).content_hash == result["content_hash"]
    split = read_split(split_path(folder))
    assert (split.recovered, split.side("round-001")) == (
        ("round-001",),
        read_split(split_path(whole)).side("round-001"),
    )
    assert verify(folder, "full").ok
    assert f"{40 + saved}/{40 + saved} frames" in done.stderr
    initialise_folder(folder, make_small_plan(3, 20))
    assert Dataset.open(folder).rounds  # readers can also open it while rounds are recorded


def test_a_recovered_round_is_merged(whole: Path, tmp_path: Path) -> None:
    folder, saved = with_recovered(whole, tmp_path / "data")
    merged = merge([folder], tmp_path / "out")
    assert (merged.rounds, merged.frames) == (3, 40 + saved)
    assert read_split(split_path(tmp_path / "out")).recovered == ("round-001",)
    assert verify(tmp_path / "out", "full").ok


@pytest.mark.parametrize("steps", [[[0, 1]], [[1, 0]], [[1], [0, 1]]])
def test_merge_prefers_an_undamaged_round_to_a_recovered_one(
    whole: Path, tmp_path: Path, steps: list[list[int]]
) -> None:
    recovered, saved = with_recovered(whole, tmp_path / "data")
    folders, out = (whole, recovered), tmp_path / "out"
    for number, step in enumerate(steps):
        # The last step replaces the recovered round if an earlier step has copied it.
        merged = merge([folders[i] for i in step], out)
        assert (merged.rounds, merged.added) == (3, 3 if number == 0 else 1)
    assert (merged.frames, saved < 20) == (60, True)
    assert files(out) == files(whole)
    assert read_split(split_path(out)).recovered == ()
    assert verify(out, "full").ok


def test_merge_takes_the_recovered_round_with_the_most_frames(whole: Path, tmp_path: Path) -> None:
    one, saved = with_recovered(whole, tmp_path / "one")
    other, fewer = with_recovered(whole, tmp_path / "other", kept=0.5)
    assert fewer < saved
    for number, folders in enumerate(([one, other], [other, one])):
        assert merge(folders, tmp_path / f"out{number}").frames == 40 + saved
