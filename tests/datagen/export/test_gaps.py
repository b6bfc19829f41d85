"""`datagen export` of a recovered round, which has a gap where frames were lost."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from datagen.recording import Dataset
from datagen.recording.folder import prepare, round_path
from datagen.recording.integrity.recover import recover
from datagen.recording.manifest import rebuild
from datagen.recording.mcap.footer import read_summary
from datagen.recording.splits import Split
from tests.datagen.commands import datagen_here
from tests.datagen.conftest import FRAMES, Samples


def test_frames_on_both_sides_of_a_gap_are_in_different_episodes(
    samples: Samples, tmp_path: Path
) -> None:
    folder, file, out = (tmp_path / name for name in ("data", "r007.mcap", "out"))
    prepare(folder)
    samples.add_round(folder, samples.header("r008", frequency_hz=4))
    samples.write(file, samples.header("r007", frequency_hz=4), samples.frames(60, seed=3))
    data = bytearray(file.read_bytes())
    chunks = read_summary(memoryview(bytes(data))).chunks
    data[chunks[len(chunks) // 2].start + 500] ^= 1
    file.write_bytes(data)
    saved = recover(file, round_path(folder, "r007")).saved
    rebuild(folder, Split(("r007",), ("r008",), recovered=("r007",)))
    done = datagen_here("export", folder, "--out", out, "--format", "lerobot")
    assert done.returncode == 0, done.stderr
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [e["round"] for e in episodes] == ["r007", "r007", "r008"]
    first, second, whole = (e["length"] for e in episodes)
    assert (first + second, whole) == (saved, FRAMES)
    info = json.loads((out / "meta/info.json").read_text())
    assert info["splits"] == {"train": "0:2", "test": "2:3"}
    assert (info["total_episodes"], info["total_frames"]) == (3, saved + FRAMES)
    table = pq.read_table(out / "data/chunk-000/file-000.parquet")
    assert table["episode_index"].to_pylist() == [0] * first + [1] * second + [2] * FRAMES
    for episode in episodes:
        rows = table.slice(episode["dataset_from_index"], episode["length"])
        times = np.arange(episode["length"]) / 4
        np.testing.assert_array_equal(rows["timestamp"].to_numpy(), times.astype(np.float32))
    frames = Dataset.open(folder).select("train")
    np.testing.assert_array_equal(
        np.array(table["labels"].to_pylist(), np.float32)[:saved, :5], frames.labels.distances
    )
