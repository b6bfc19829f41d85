"""`datagen export`: read back with the target libraries; complete or not written at all."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pyarrow.parquet as pq
import pytest
import webdataset
from typer.testing import CliRunner

from datagen.cli import app
from datagen.export.lerobot_features import ACTION, IMAGE, LABELS
from datagen.export.lerobot_stats import Histogram, column_stats
from datagen.export.webdataset import SCHEMA_FILE
from datagen.recording.dataset import Dataset
from datagen.recording.folder import prepare
from datagen.recording.manifest import rebuild
from datagen.recording.splits import Split
from tests.datagen.conftest import FRAMES, Samples

Refused = Callable[..., str]


def export(dataset: Path, out: Path, *more: str) -> dict[str, Any]:
    done = CliRunner().invoke(app, ["export", str(dataset), "--out", str(out), "--json", *more])
    assert done.exit_code == 0, done.exception
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def read_shards(*paths: Path) -> list[dict[str, Any]]:
    shards = webdataset.WebDataset([str(path) for path in paths], shardshuffle=False)
    return list(shards.decode(webdataset.autodecode.basichandlers))


def test_webdataset_gives_every_image_and_label_as_recorded(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "shards"
    result = export(dataset, out, "--shard-size", "40")
    assert (result["frames"], result["rounds"], result["files"]) == (3 * FRAMES, 3, 7)
    names = sorted(path.name for path in out.glob("*.tar"))
    assert names == [f"{s}-{n:06d}.tar" for s, count in (("test", 2), ("train", 3)) for n in
                     range(count)]  # fmt: skip
    schema = jsonschema.Draft202012Validator(json.loads((out / SCHEMA_FILE).read_text()))
    for side in ("train", "test"):
        frames = Dataset.open(dataset).select(side)
        samples = read_shards(*sorted(out.glob(f"{side}-*.tar")))
        assert len(samples) == len(frames)
        for i, sample in enumerate(samples):
            about = sample["json"]
            schema.validate(about)
            assert sample["jpg"] == bytes(frames.jpeg(i))
            assert sample["__key__"] == f"{about['round']}-{i % FRAMES:06d}"
            assert (about["frame"], about["split"]) == (i % FRAMES, side)
            assert about["time_s"] == pytest.approx(i % FRAMES / 20)
            assert _distances(about) == pytest.approx(frames.labels.distances[i], nan_ok=True)
            assert (
                about["labels"]["heading"]
                == ["left", "straight", "right"][frames.labels.heading[i]]
            )
            assert about["ego"]["vx"] == pytest.approx(frames.labels.speed[i])
            assert about["command"] == {"steer": 0.1, "throttle": 0.2, "brake": 0.0, "gear": 3}


def _distances(about: dict[str, Any]) -> list[float]:
    found = [about["labels"][f"to_marking_{name}"] for name in ("ml", "mr", "l", "m", "r")]
    return [np.nan if value is None else value for value in found]


def test_an_absent_label_is_null_in_the_samples_and_refused_where_it_must_be_there(
    dataset: Path, tmp_path: Path
) -> None:
    export(dataset, tmp_path / "out")
    samples = read_shards(tmp_path / "out/train-000000.tar")
    absent = [s["json"] for s in samples if s["json"]["labels"]["to_marking_m"] is None]
    assert 0 < len(absent) < len(samples)
    schema = json.loads((tmp_path / "out" / SCHEMA_FILE).read_text())
    absent[0]["labels"]["angle"] = None
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(absent[0], schema)
    assert schema["properties"]["labels"]["properties"]["angle"]["x-unit"] == "rad"


def test_names_that_differ_in_a_dot_have_different_keys(samples: Samples, tmp_path: Path) -> None:
    prepare(tmp_path / "data")
    for number, name in enumerate(("drive.1", "drive_1", "test")):
        header = replace(samples.header(f"r{number:03d}"), id=name)
        samples.add_round(tmp_path / "data", header)
    rebuild(tmp_path / "data", Split(train=("drive.1", "drive_1"), test=("test",)))
    export(tmp_path / "data", tmp_path / "out")
    keys = [s["__key__"] for s in read_shards(*(tmp_path / "out").glob("*.tar"))]
    assert len(set(keys)) == len(keys) == 3 * FRAMES


def test_rounds_with_long_names_are_exported(samples: Samples, tmp_path: Path) -> None:
    prepare(tmp_path / "data")
    names = ("r" * 128, "." * 127 + "r", "r" * 88, "r" * 87)
    for number, name in enumerate(names):
        header = replace(samples.header(f"r{number:03d}"), id=name)
        samples.add_round(tmp_path / "data", header)
    rebuild(tmp_path / "data", Split(train=names, test=()))
    export(tmp_path / "data", tmp_path / "out", "--format", "lerobot")
    export(tmp_path / "data", tmp_path / "shards")
    found = read_shards(*(tmp_path / "shards").glob("*.tar"))
    keys = {f"{name.replace('.', '%2E')}-{i:06d}" for name in names for i in range(FRAMES)}
    assert {s["__key__"] for s in found} == keys
    assert len(found) == len(keys)


def test_the_same_dataset_gives_the_same_bytes_and_shuffling_the_same_order(
    dataset: Path, tmp_path: Path
) -> None:
    for name, more in (("a", ()), ("b", ()), ("c", ("--shuffle",)), ("d", ("--shuffle",))):
        export(dataset, tmp_path / name, *more)
    tars = {n: (tmp_path / n / "train-000000.tar").read_bytes() for n in "abcd"}
    assert tars["a"] == tars["b"]
    assert tars["c"] == tars["d"] != tars["a"]
    keys = {n: [s["__key__"] for s in read_shards(tmp_path / n / "train-000000.tar")] for n in "ac"}
    assert sorted(keys["c"]) == keys["a"]
    assert keys["c"] != keys["a"]


def test_one_side_is_exported_alone_and_rounds_of_no_side_by_their_name(
    dataset: Path, tmp_path: Path
) -> None:
    assert export(dataset, tmp_path / "test", "--split", "test")["frames"] == FRAMES
    assert [p.name for p in (tmp_path / "test").glob("*.tar")] == ["test-000000.tar"]
    rebuild(dataset, Split(train=("r000",), test=("r002",)))
    export(dataset, tmp_path / "all")
    names = {path.name for path in (tmp_path / "all").glob("*.tar")}
    assert names == {"train-000000.tar", "test-000000.tar", "unsplit-000000.tar"}


def test_lossless_rounds_are_exported_as_png(samples: Samples, tmp_path: Path) -> None:
    folder = tmp_path / "data"
    (folder / "rounds").mkdir(parents=True)
    (folder / "splits").mkdir()
    (folder / "state").mkdir()
    samples.add_round(folder, samples.header("r000", codec="png"))
    rebuild(folder, Split(train=("r000",), test=()))
    export(folder, tmp_path / "out")
    assert read_shards(tmp_path / "out/train-000000.tar")[3]["png"][1:4] == b"PNG"
    export(folder, tmp_path / "lerobot", "--format", "lerobot")
    row = pq.read_table(tmp_path / "lerobot/data/chunk-000/file-000.parquet").slice(3, 1)
    image = row[IMAGE][0].as_py()
    assert (image["bytes"][1:4], image["path"]) == (b"PNG", "frame-000003.png")


def test_lerobot_holds_every_image_label_and_command(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "lerobot"
    result = export(dataset, out, "--format", "lerobot")
    assert (result["frames"], result["files"]) == (3 * FRAMES, 6)
    frames = Dataset.open(dataset).select("all")
    table = pq.read_table(out / "data/chunk-000/file-000.parquet")
    assert [image["bytes"] for image in table[IMAGE].to_pylist()] == [
        bytes(frames.jpeg(i)) for i in range(len(frames))
    ]
    labels = np.array(table["labels"].to_pylist(), np.float32)
    np.testing.assert_array_equal(labels[:, :5], frames.labels.distances)
    for name in ("to_lane_centre", "angle", "heading", "curvature", "to_middle", "s"):
        np.testing.assert_array_equal(labels[:, LABELS.index(name)], getattr(frames.labels, name))
    actions = np.array(table["action"].to_pylist())
    assert actions[7].tolist() == pytest.approx([0.1, 0.2, 0.0, 3.0])
    assert table["index"].to_pylist() == list(range(3 * FRAMES))
    assert table["frame_index"].to_pylist() == 3 * list(range(FRAMES))
    assert table["timestamp"].to_numpy()[FRAMES + 2] == pytest.approx(0.1)
    assert b'"_type": "Image"' in table.schema.metadata[b"huggingface"]


def test_lerobot_says_what_it_holds(dataset: Path, tmp_path: Path) -> None:
    """Names and keys are those that lerobot 0.4.4 reads and writes."""
    out = tmp_path / "lerobot"
    export(dataset, out, "--format", "lerobot")
    info = json.loads((out / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"]) == ("v3.0", 20)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 135, 1)
    assert info["splits"] == {"train": "0:2", "test": "2:3"}
    assert info["features"][IMAGE]["shape"] == [42, 56, 3]
    assert info["features"]["action"]["names"] == list(ACTION)
    tasks = pq.read_table(out / "meta/tasks.parquet").to_pandas()
    assert tasks.index.tolist() == ["drive, trajectory: weave"]
    assert tasks.loc["drive, trajectory: weave", "task_index"] == 0
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(e["dataset_from_index"], e["dataset_to_index"]) for e in episodes] == [
        (0, 45), (45, 90), (90, 135),
    ]  # fmt: skip
    assert [e["round"] for e in episodes] == ["r000", "r001", "r002"]
    assert {(e["data/chunk_index"], e["data/file_index"], e["length"]) for e in episodes} == {
        (0, 0, FRAMES)
    }


def test_lerobots_statistics_are_those_of_the_frames(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "lerobot"
    export(dataset, out, "--format", "lerobot")
    stats = json.loads((out / "meta/stats.json").read_text())
    frames = Dataset.open(dataset).select("all")
    ml = frames.labels.distances[:, 0]
    assert stats["labels"]["mean"][0] == pytest.approx(float(np.nanmean(ml)))
    assert stats["labels"]["std"][0] == pytest.approx(float(np.nanstd(ml)), rel=1e-5)
    assert stats["labels"]["q90"][0] == pytest.approx(float(np.nanquantile(ml, 0.9)), rel=1e-5)
    assert stats["labels"]["count"] == [135]
    pixels = frames.read_batch(list(range(135))) / 255.0
    for kind in ("mean", "std", "min", "max"):
        found = np.array(stats[IMAGE][kind])
        assert found.shape == (3, 1, 1)
        expected = getattr(pixels, kind)(axis=(0, 1, 2))
        assert found.ravel() == pytest.approx(expected, abs=1e-9)
    assert stats[IMAGE]["count"] == [135]
    median = np.median(pixels, axis=(0, 1, 2))
    assert np.array(stats[IMAGE]["q50"]).ravel() == pytest.approx(median, abs=1 / 255)
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert episodes[2]["stats/labels/min"][0] == pytest.approx(float(np.nanmin(ml[90:])))


def test_a_distance_absent_in_all_frames_has_statistics_of_zero() -> None:
    stats = column_stats({"labels": np.array([[1.0, np.nan], [3.0, np.nan]], np.float32)})["labels"]
    assert (stats["mean"], stats["std"], stats["count"]) == ([2.0, 0.0], [1.0, 0.0], [2])


def test_levels_are_counted_exactly() -> None:
    histogram = Histogram()
    histogram.counts[:, 0], histogram.counts[:, 255], histogram.images = 3, 1, 1
    stats = histogram.stats()
    assert (stats["min"][0], stats["max"][0]) == ([[0.0]], [[1.0]])
    assert stats["mean"][1] == [[0.25]]
    assert stats["std"][2] == [[pytest.approx(np.sqrt(3) / 4)]]
    assert (stats["q50"][0], stats["q90"][0]) == ([[0.0]], [[1.0]])


def test_large_exports_are_cut_into_files(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("datagen.export.lerobot.FILE_MB", 0)
    monkeypatch.setattr("datagen.export.lerobot.CHUNK_FILES", 2)
    out = tmp_path / "lerobot"
    export(dataset, out, "--format", "lerobot")
    files = sorted(str(path.relative_to(out / "data")) for path in out.glob("data/*/*"))
    expected = [(0, 0), (0, 1), (1, 0)]
    assert files == [f"chunk-{c:03d}/file-{f:03d}.parquet" for c, f in expected]
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(e["data/chunk_index"], e["data/file_index"]) for e in episodes] == expected


def test_what_cannot_be_exported_is_refused_in_one_line(
    dataset: Path, tmp_path: Path, refused: Refused, samples: Samples
) -> None:
    out = tmp_path / "out"
    assert "no format 'zip'" in refused("export", dataset, "--format", "zip", "--out", out)
    assert "--shard-size is 0" in refused("export", dataset, "--shard-size", "0", "--out", out)
    assert "--shuffle" in refused(
        "export", dataset, "--format", "lerobot", "--shuffle", "--out", out
    )
    assert "leave out --shard-size" in refused(
        "export", dataset, "--format", "lerobot", "--shard-size", "1000", "--out", out
    )
    assert "no side 'dev'" in refused("export", dataset, "--split", "dev", "--out", out)
    assert "holds no recorded rounds" in refused("export", tmp_path / "no", "--out", out)
    samples.add_round(dataset, samples.header("r003", frequency_hz=10))
    assert "one rate" in refused("export", dataset, "--format", "lerobot", "--out", out)
    assert not out.exists()
    assert not (tmp_path / ".out.partial").exists()
    out.mkdir()
    (out / "mine").touch()
    assert "is not empty" in refused("export", dataset, "--out", out)
    assert "no folder to write to" in refused("export", dataset, "--out", out / "mine")


def test_without_pyarrow_the_line_says_what_to_install(
    dataset: Path, tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("datagen.export.run.find_spec", lambda name: None)
    line = refused("export", dataset, "--format", "lerobot", "--out", tmp_path / "out")
    assert "driverview[export]" in line


@pytest.mark.parametrize("kind", ["webdataset", "lerobot"])
def test_a_full_disk_leaves_nothing(
    dataset: Path, tmp_path: Path, refused: Refused, fill_disk: Callable[[], None], kind: str
) -> None:
    fill_disk()
    line = refused("export", dataset, "--format", kind, "--out", tmp_path / "out")
    assert "the disk is full" in line
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / ".out.partial").exists()


KILLED = """
import os, signal, sys
from datagen.cli import main
from datagen.export import webdataset

add, count = webdataset._add, iter(range(100))
def dying(*args):
    add(*args)
    if next(count) == 99:
        os.kill(os.getpid(), signal.SIGKILL)
webdataset._add = dying
sys.argv = ["datagen", "export", *sys.argv[1:]]
main()
"""


def test_a_killed_export_is_not_there_and_the_next_one_is_whole(
    dataset: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    done = subprocess.run([sys.executable, "-c", KILLED, str(dataset), "--out", str(out)])
    assert done.returncode == -9
    assert not out.exists()
    assert any((tmp_path / ".out.partial").glob("*.tar"))
    assert export(dataset, out)["files"] == 4
    assert not (tmp_path / ".out.partial").exists()
    assert len(read_shards(out / "train-000000.tar")) == 2 * FRAMES


def test_a_second_export_to_the_same_place_is_refused(
    dataset: Path, tmp_path: Path, refused: Refused
) -> None:
    from datagen.export.output_folder import new_folder

    with new_folder(tmp_path / "out") as partial:
        (partial / "a").write_text("mine")
        line = refused("export", dataset, "--out", tmp_path / "out")
        assert "another `datagen export` is writing" in line
    assert (tmp_path / "out/a").read_text() == "mine"


def test_without_out_it_stands_beside_the_dataset(dataset: Path) -> None:
    done = CliRunner().invoke(app, ["export", str(dataset)])
    assert done.exit_code == 0, done.exception
    assert "135 frames of 3 rounds" in done.stdout
    beside = dataset.with_name("data-webdataset")
    about = (beside / "README.md").read_text()
    assert "Train 90 frames of 2 rounds, test 45 frames of 1 round" in about
    assert 'urls = "train-{000000..000000}.tar"' in about
