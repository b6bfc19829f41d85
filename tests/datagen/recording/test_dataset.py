"""Opening a dataset: labels, batches of images, and refused datasets."""

import json
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording import Dataset, DatasetError, UndecodableImage
from datagen.recording.folder import prepare
from datagen.recording.images import decode_into
from datagen.recording.manifest import rebuild
from datagen.recording.round_metadata import RoundHeader, RoundResult
from datagen.recording.splits import Split, split_path, write_split
from tests.datagen.chunk_crcs import with_right_crcs
from tests.datagen.conftest import Samples


def test_random_roads_are_counted_as_one_track(samples: Samples, tmp_path: Path) -> None:
    prepare(tmp_path)
    for number, track in enumerate(("random:4", "random:15", "a-track")):
        samples.add_round(tmp_path, samples.header(f"r{number:03d}", track=track))
    statistics = rebuild(tmp_path, Split(train=("r000", "r002"), test=("r001",)))
    assert statistics["by_track"] == {"a-track": 45, "random": 90}
    rounds = Dataset.open(tmp_path).rounds
    assert [info.track for info in rounds] == ["random:4", "random:15", "a-track"]
    assert [info.values_of("track") for info in rounds] == [("random",), ("random",), ("a-track",)]


def test_rounds_sides_and_labels_are_read_back(samples: Samples, dataset: Path) -> None:
    opened = Dataset.open(dataset)
    assert [(info.id, info.split, info.frames) for info in opened.rounds] == [
        ("r000", "train", 45),
        ("r001", "train", 45),
        ("r002", "test", 45),
    ]
    assert opened.camera == samples.camera
    train, test = opened.select("train"), opened.select("test")
    assert (len(train), len(test), len(opened.select("all"))) == (90, 45, 135)
    expected = [f for seed in (0, 1) for f in samples.frames(45, seed)]
    labels = train.labels
    for i, frame in enumerate(expected):
        wanted = [np.nan if d is None else d for d in frame.features.distances.values()]
        assert np.array_equal(labels.distances[i], np.array(wanted, np.float32), equal_nan=True)
        centre = frame.features.to_lane_centre
        assert np.isnan(labels.to_lane_centre[i]) == (centre is None)
        assert labels.angle[i] == np.float32(frame.features.angle)
        assert labels.heading[i] == frame.features.heading
        assert labels.to_middle[i] == np.float32(frame.place.to_middle)
        assert labels.lane_index[i] == frame.place.lane_index
        assert labels.speed[i] == np.float32(frame.ego.vx)
        assert labels.shadow_fraction[i] == np.float32(frame.ego.shadow_fraction)
    assert labels.round.tolist() == [0] * 45 + [1] * 45


def test_batches_are_in_the_order_of_the_indices(dataset: Path) -> None:
    frames = Dataset.open(dataset).select("all")
    wanted = [134, 0, 77, 44, 45, 77]
    batch = frames.read_batch(wanted, np.empty((6, 42, 56, 3), np.uint8))
    one = np.empty((42, 56, 3), np.uint8)
    for row, i in enumerate(wanted):
        decode_into(frames.jpeg(i), one)
        assert np.array_equal(batch[row], one)
    assert not np.array_equal(batch[0], batch[1])


def test_every_third_frame_keeps_its_label_and_image(dataset: Path) -> None:
    frames = Dataset.open(dataset).select("all")
    third = frames.every(3)
    assert len(third) == len(third.labels) == 45
    assert np.array_equal(third.labels.angle, frames.labels.angle[::3])
    assert np.array_equal(third.read_batch([44, 7]), frames.read_batch([132, 21]))


def test_large_batches_equal_libjpeg_turbo_image_by_image(dataset: Path) -> None:
    frames = Dataset.open(dataset).select("all")
    wanted = np.random.default_rng(0).permutation(135)[:100]
    images = [simplejpeg.decode_jpeg(bytes(frames.jpeg(i)), "RGB") for i in wanted.tolist()]
    expected = np.stack(images)
    assert np.array_equal(frames.read_batch(wanted), expected)
    apart = np.zeros((200, 42, 56, 3), np.uint8)  # with gaps
    assert np.array_equal(frames.read_batch(wanted, apart[::2]), expected)
    assert not apart[1::2].any()


def test_the_first_damaged_image_of_a_batch_is_named(dataset: Path) -> None:
    good = Dataset.open(dataset).select("all")
    path = dataset / "rounds" / "r001.mcap"
    data = path.read_bytes()
    for i in (50, 55, 60):
        image = bytes(good.jpeg(i))
        data = data.replace(image, b"\0\0" + image[2:])
    path.write_bytes(with_right_crcs(data))
    frames = Dataset.open(dataset).select("all")
    with pytest.raises(DatasetError, match=r"image 5 of .*r001\.mcap cannot be read: neither JPEG"):
        frames.read_batch(np.arange(40, 72))
    assert frames.read_batch(np.arange(61, 83)).any()
    with pytest.raises(IndexError, match="frame 135 of 135"):
        frames.read_batch(np.arange(120, 152))


def test_no_thread_writes_to_the_batch_after_an_error(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started, finished = [], []

    def decode_slowly(data: memoryview, out: NDArray[np.uint8]) -> None:
        started.append(data)
        if len(started) == 1:
            raise ValueError("damaged")
        time.sleep(0.05)
        finished.append(data)

    monkeypatch.setattr("datagen.recording.dataset.decode_into", decode_slowly)
    with pytest.raises(UndecodableImage, match="damaged"):
        Dataset.open(dataset).select("all").read_batch(range(4))
    assert len(started) == len(finished) + 1


def test_the_example_of_the_documentation_runs_on_a_dataset(
    dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (Path(__file__).parents[3] / "docs" / "how-to" / "collect.md").read_text()
    (snippet,) = re.findall(r"```python\n(from datagen\.recording.*?)```", text, flags=re.DOTALL)
    assert snippet.count("\n") <= 6
    names: dict[str, Any] = {}
    exec(snippet.replace("datasets/default", str(dataset)).replace("500, 1000", "50, 80"), names)
    assert names["images"].shape == (3, 42, 56, 3)
    assert capsys.readouterr().out.startswith("90 [")
    frames = Dataset.open(dataset).select("train")
    assert np.array_equal(names["images"][1], frames.image(50))


def test_a_batch_of_another_shape_is_refused(dataset: Path) -> None:
    frames = Dataset.open(dataset).select("all")
    with pytest.raises(ValueError, match=r"expected uint8 \(2, 42, 56, 3\)"):
        frames.read_batch([0, 1], np.empty((2, 56, 42, 3), np.uint8))
    fixed = np.empty((2, 42, 56, 3), np.uint8)
    fixed.flags.writeable = False
    for out in (fixed, np.empty((2, 42, 112, 3), np.uint8)[:, :, ::2], fixed[..., ::-1]):
        with pytest.raises(ValueError, match="`out` is read-only or has gaps within an image"):
            frames.read_batch([0, 1], out)
    assert frames.read_batch([], np.empty((0, 42, 56, 3), np.uint8)).shape == (0, 42, 56, 3)
    with pytest.raises(IndexError):
        frames.jpeg(135)


def test_header_and_result_round_trip_through_metadata(samples: Samples) -> None:
    header = samples.header(program='with "quotes" and = signs')
    assert RoundHeader.from_metadata(header.to_metadata()) == header
    result = RoundResult(7, "ab", laps=2, resets=1, distance_m=0.1, mean_speed_kmh=51.25)
    assert RoundResult.from_metadata(result.to_metadata()) == result


@pytest.mark.parametrize(
    ("changes", "content", "test", "what"),
    [
        ({"seed": 0}, 77, ("r002", "r003"), "seed 0"),
        ({}, 1, ("r002", "r003"), "content"),
        ({}, 77, ("r001", "r002"), "round r001"),
    ],
)
def test_a_split_with_a_seed_content_or_round_on_both_sides_is_refused(
    samples: Samples,
    dataset: Path,
    changes: dict[str, Any],
    content: int,
    test: tuple[str, ...],
    what: str,
) -> None:
    samples.add_round(dataset, samples.header("r003", **changes), content_seed=content)
    write_split(split_path(dataset), Split(("r000", "r001"), test))
    with pytest.raises(DatasetError, match=f"{what}.* on both sides"):
        Dataset.open(dataset)


def test_other_definitions_are_refused(samples: Samples, dataset: Path) -> None:
    samples.add_round(dataset, samples.header("r003", definitions="0-old"))
    with pytest.raises(tf.DefinitionsMismatch, match="0-old"):
        Dataset.open(dataset)


def test_other_definitions_of_a_split_are_refused(dataset: Path) -> None:
    path = split_path(dataset)
    path.write_text(json.dumps({**json.loads(path.read_text()), "definitions": "0-old"}))
    with pytest.raises(tf.DefinitionsMismatch, match="0-old"):
        Dataset.open(dataset)


def test_two_cameras_in_one_dataset_are_refused(samples: Samples, dataset: Path) -> None:
    from dataclasses import replace

    tilted = replace(samples.camera, pitch_deg=5.0)
    samples.add_round(dataset, samples.header("r003", camera=tilted))
    with pytest.raises(DatasetError, match="different cameras"):
        Dataset.open(dataset)


def test_a_folder_or_side_without_rounds_is_refused(samples: Samples, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="holds no recorded rounds"):
        Dataset.open(tmp_path)
    prepare(tmp_path)
    samples.add_round(tmp_path, samples.header("r000"))
    rebuild(tmp_path, Split(train=("r000",), test=()))
    with pytest.raises(DatasetError, match="none for test"):
        Dataset.open(tmp_path).select("test")
    with pytest.raises(DatasetError, match="no side 'dev'"):
        Dataset.open(tmp_path).select("dev")


def test_the_content_hash_is_independent_of_round_names(samples: Samples, tmp_path: Path) -> None:
    hashes = []
    for name, ids in (("a", ("r001", "r002")), ("b", ("r008", "r007"))):
        prepare(tmp_path / name)
        for round_id, content in zip(ids, (1, 2), strict=True):
            samples.add_round(tmp_path / name, samples.header(round_id), content_seed=content)
        rebuild(tmp_path / name, Split(train=ids, test=()))
        hashes.append(Dataset.open(tmp_path / name).content_hash)
    assert hashes[0] == hashes[1]


def test_the_derived_files_are_rebuilt_from_the_rounds_alone(dataset: Path) -> None:
    names = ("manifest.json", "stats.json", "README.md")
    before = {name: (dataset / name).read_bytes() for name in names}
    for name in names:
        (dataset / name).unlink()
    statistics = rebuild(dataset, Split(("r000", "r001"), ("r002",)))
    assert {name: (dataset / name).read_bytes() for name in names} == before
    labels = Dataset.open(dataset).select("all").labels
    assert statistics["all"]["mean_deviation"]["angle"] == pytest.approx(
        float(np.abs(labels.angle - labels.angle.mean()).mean()), abs=1e-5
    )
    assert sum(statistics["all"]["heading"].values()) == pytest.approx(1.0, abs=1e-3)
    manifest = json.loads(before["manifest.json"])
    assert [entry["split"] for entry in manifest["rounds"]] == ["train", "train", "test"]
    assert (dataset / "proto" / "driverview.proto").read_text().count("\nmessage ") == 4
