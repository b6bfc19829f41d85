"""Unusable datasets: one error message with the reason, and no files written."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trackfeatures as tf
from datagen.recording import Dataset, DatasetError, UndecodableImage
from datagen.recording.mcap.footer import read_summary
from datagen.recording.splits import Split, split_path, write_split
from mtlnet.ablation.config import AblationConfig
from mtlnet.ablation.plan import ablation_rows
from mtlnet.ablation.run import ablate
from mtlnet.data.rounds import find_undecodable
from mtlnet.evaluation.evaluate import evaluate
from mtlnet.inference.engine import load_engine
from mtlnet.train import train
from mtlnet.training.config import TrainConfig
from mtlnet.training.sources import recorded_training_data
from tests.datagen.chunk_crcs import with_right_crcs
from tests.mtlnet.conftest import FRAMES, TRAIN, write_round
from tests.typed import typed
from trackfeatures.errors import UserError

pytestmark = pytest.mark.usefixtures("short_fit", "no_graph")


def damage(folder: Path, name: str, frame: int) -> None:
    """Overwrite part of the JPEG data of one image in a round's file."""
    frames = Dataset.open(folder).select("all")
    first = [info.id for info in frames.rounds].index(name) * FRAMES
    jpeg = bytes(frames.jpeg(first + frame))
    path = folder / "rounds" / f"{name}.mcap"
    content = path.read_bytes()
    assert content.count(jpeg) == 1
    at, middle = content.index(jpeg), len(jpeg) // 2
    damaged_content = content[: at + middle] + b"\xff\xd9" * 40 + content[at + middle + 80 :]
    path.unlink()  # the old file may be memory-mapped
    path.write_bytes(with_right_crcs(damaged_content))


@pytest.fixture
def damaged(dataset: Path, tmp_path: Path) -> Path:
    """The dataset with two train images and a test image that cannot be decoded."""
    folder = shutil.copytree(dataset, tmp_path / "damaged")
    for name, frame in (("r000", 7), ("r002", 20), ("r003", 2)):
        damage(folder, name, frame)
    return folder


def config(data: Path, out: Path, **changes: Any) -> TrainConfig:
    values = {"iterations": 2, "batch": 4, "device": "cpu", "threads": 1, **changes}
    return TrainConfig(data, out, **values)


def ablation(data: Path, out: Path, **changes: Any) -> None:
    given = AblationConfig(out, data=data, iterations=1, seeds=(1,), batch=2, **changes)
    ablate(given, ablation_rows())


def judge(published: Path, data: Path, split: str) -> dict[str, Any]:
    return evaluate([load_engine(published, "torch")], data, split)


def test_undecodable_images_are_found_by_round_and_frame(damaged: Path) -> None:
    frames = Dataset.open(damaged).select("train")
    found = find_undecodable(frames)
    assert sorted(found) == [7, 2 * FRAMES + 20]
    assert {(e.round_id, e.frame) for e in found.values()} == {("r000", 7), ("r002", 20)}
    rest = frames.without(found)
    assert len(rest) == len(frames) - 2
    assert find_undecodable(rest) == {}
    # Frames after the gap keep their images and labels.
    np.testing.assert_array_equal(rest.image(7), frames.image(8))
    kept = np.delete(frames.labels.distances, sorted(found), axis=0)
    np.testing.assert_array_equal(rest.labels.distances, kept)
    with pytest.raises(UndecodableImage, match=r"image 20 of .*r002\.mcap cannot be read"):
        frames.image(2 * FRAMES + 20)


def test_frames_of_a_damaged_chunk_are_left_out_with_their_labels(
    dataset: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(dataset, tmp_path / "damaged")
    path = folder / "rounds" / "r000.mcap"
    content = bytearray(path.read_bytes())
    start = read_summary(memoryview(path.read_bytes())).chunks[0].start
    content[start + 20_000] ^= 0x10
    path.unlink()
    path.write_bytes(content)
    frames = Dataset.open(folder).select("train")
    found = find_undecodable(frames)
    assert sorted(found) == list(range(FRAMES))  # a round of 24 frames is one chunk
    with pytest.raises(DatasetError, match=r"a label is damaged .the chunk at byte"):
        _ = frames.labels
    rest = frames.without(found)
    whole = Dataset.open(dataset).select("train").labels.distances
    np.testing.assert_array_equal(rest.labels.distances, whole[FRAMES:])
    data = recorded_training_data(Dataset.open(folder), skip_undecodable=True)
    assert data.about["frames"] == 2 * FRAMES


@pytest.mark.usefixtures("small_network")
def test_training_refuses_undecodable_images_without_skip_option(
    damaged: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    seen = (
        rf"2 of {3 * FRAMES} images in .*damaged cannot be decoded: image 7 of round r000, "
        r"image 20 of round r002 \(.*\); record .* --skip-undecodable"
    )
    with pytest.raises(UserError, match=seen) as caught:
        train(config(damaged, out), None)
    assert "\n" not in str(caught.value)
    assert not out.exists()
    given = ["--data", damaged, "--out", out, "--iterations", 2, "--batch", 4, "--json"]
    assert "--skip-undecodable" in typed("mtlnet", "train", *given).stderr
    done = typed("mtlnet", "train", *given, "--skip-undecodable")
    assert done.returncode == 0, done.stderr
    data = json.loads((out / "card.json").read_text())["data"]
    assert data["undecodable"] == ["r000/7", "r002/20"]
    assert data["frames"] == 3 * FRAMES - 2


@pytest.mark.usefixtures("small_network")
def test_training_fails_when_all_images_are_undecodable(dataset: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(dataset, tmp_path / "data")
    write_split(split_path(folder), Split(("r001",), ("r003",)))
    for frame in range(FRAMES):
        damage(folder, "r001", frame)
    with pytest.raises(UserError, match=rf"{FRAMES} of {FRAMES} images .* and {FRAMES - 5} more"):
        train(config(folder, tmp_path / "run", skip_undecodable=True), None)
    assert not (tmp_path / "run").exists()


def test_evaluation_names_undecodable_images(damaged: Path, published: Path) -> None:
    damage(damaged, "r003", 11)
    with pytest.raises(UserError, match=rf"2 of {FRAMES} images .* image 2 of round r003, image"):
        judge(published, damaged, "test")


def test_ablation_checks_train_and_test_images_first(damaged: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=rf"2 of {3 * FRAMES} images .* image 7 of round r000"):
        ablation(damaged, tmp_path / "out")
    write_split(split_path(damaged), Split(("r001",), ("r003",)))
    with pytest.raises(UserError, match=rf"1 of {FRAMES} images .* image 2 of round r003"):
        ablation(damaged, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_labels_of_another_definitions_version_are_refused(
    dataset: Path, published: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(dataset, tmp_path / "data")
    write_round(folder, "r009", 9, definitions="0-old")
    seen = r"r009.mcap was made with version '0-old' of the track-feature definitions, "
    seen += rf".* '{tf.VERSION}'; make"
    with pytest.raises(UserError, match=seen):
        train(config(folder, tmp_path / "run"), None)
    with pytest.raises(UserError, match=seen):
        judge(published, folder, "test")
    with pytest.raises(UserError, match=seen):
        ablation(folder, tmp_path / "out")
    assert not (tmp_path / "run").exists()
    assert not (tmp_path / "out").exists()


def test_a_split_side_without_rounds_is_refused(
    dataset: Path, published: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(dataset, tmp_path / "data")
    write_split(split_path(folder), Split((), TRAIN))
    with pytest.raises(UserError, match="4 rounds but none for train; collect more"):
        train(config(folder, tmp_path / "run"), None)
    with pytest.raises(UserError, match="4 rounds but none for train"):
        ablation(folder, tmp_path / "out")
    with pytest.raises(UserError, match="4 rounds but none for unseen"):
        ablation(dataset, tmp_path / "out", split="unseen")
    with pytest.raises(UserError, match="4 rounds but none for unseen"):
        judge(published, folder, "unseen")
    with pytest.raises(UserError, match="no side 'tests' of a split; choose train, test"):
        judge(published, folder, "tests")
    assert not (tmp_path / "run").exists()
    assert not (tmp_path / "out").exists()
