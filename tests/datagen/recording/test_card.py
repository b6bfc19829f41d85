"""The dataset card: YAML header, example program, statistics."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from datagen.recording.card import SIZE_CATEGORIES, render_card
from datagen.recording.dataset import Dataset
from datagen.recording.folder import prepare
from datagen.recording.manifest import rebuild
from datagen.recording.names import PLACED
from datagen.recording.schema.fields import FIELDS
from datagen.recording.schema.topics import MESSAGE_TYPES
from datagen.recording.splits import Split
from datagen.recording.statistics import describe
from tests.datagen.conftest import Samples


@pytest.fixture
def text(dataset: Path) -> str:
    return (dataset / "README.md").read_text()


def test_the_yaml_header_has_the_fields_of_the_hub(text: str) -> None:
    yaml = pytest.importorskip("yaml")
    _, head, _ = text.split("---\n", 2)
    found = yaml.safe_load(head)
    assert found["license"] == "mit"
    assert found["size_categories"] == ["n<1K"]
    assert found["pretty_name"] == "data: driver-view images and track features"
    assert {"image-classification", "robotics"} == set(found["task_categories"])
    assert found["viewer"] is False


def test_the_example_program_reads_the_dataset(text: str, dataset: Path) -> None:
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len([line for line in program.splitlines() if line]) == 5
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=dataset, capture_output=True, text=True, timeout=300
    )
    assert done.stdout.startswith("90 ["), done.stderr


def test_every_field_topic_and_file_is_listed(text: str, dataset: Path) -> None:
    for message, fields in FIELDS.items():
        assert f"`driverview.{message}`" in text
        for name, field in fields.items():
            assert f"| `{name}` | {field.unit} | {field.meaning}" in text
    for topic in MESSAGE_TYPES:
        assert f"| `{topic}` |" in text
    for named in ("splits/default.json", "proto/driverview.proto", "stats.json", "manifest.json",
                  "schemas/driverview.schema.json", "layouts/foxglove.json"):  # fmt: skip
        assert named in text
        assert (dataset / named).is_file()


def test_the_statistics_are_those_of_the_dataset(text: str, dataset: Path) -> None:
    opened = Dataset.open(dataset)
    statistics = describe(opened)
    assert opened.content_hash in text
    assert "135 frames in 3 rounds, 20 a second, 56 x 42 px" in text
    assert "never by frame: 2 train, 1 test." in text
    assert "| frames | 135 | 90 | 45 |" in text
    deviation = statistics["test"]["mean_deviation"]["angle"]
    assert re.search(
        rf"mean deviation of angle \|.*\| {deviation:.3f} rad \(100% active\) \|", text
    )
    assert "- track: a-track: 135\n" in text
    assert "JPEG, quality 95" in text


def test_size_categories_follow_the_number_of_frames(dataset: Path) -> None:
    opened = Dataset.open(dataset)
    for frames, name in ((999, "n<1K"), (1000, "1K<n<10K"), (120_000, "100K<n<1M"),
                         (10**6, "1M<n<10M")):  # fmt: skip
        assert f"size_categories:\n- {name}\n" in render_card(
            opened, describe(opened) | {"frames": frames}
        )
    assert [most for most, _ in SIZE_CATEGORIES] == sorted(most for most, _ in SIZE_CATEGORIES)


def test_camera_jitter_and_lossless_rounds_are_stated(samples: Samples, dataset: Path) -> None:
    tilted = replace(samples.camera, pitch_deg=1.5)
    header = samples.header("r003", camera=tilted, nominal_camera=samples.camera, codec="png")
    samples.add_round(dataset, header)
    rebuild(dataset, Split(("r000", "r001"), ("r002",)))
    text = (dataset / "README.md").read_text()
    assert "varied a little from round to round" in text
    assert "PNG, lossless" in text
    assert "2 train, 1 test, 1 of no side." in text


def test_only_changes_that_happen_and_true_intervals_are_stated(
    samples: Samples, tmp_path: Path
) -> None:
    """A round with one scene shows it in every stretch."""
    folder = tmp_path / "data"
    prepare(folder)
    samples.add_round(folder, samples.header("r000"))
    samples.add_round(folder, samples.header("r001", frequency_hz=4, stretch=1))
    rebuild(folder, Split(("r000",), ("r001",)))
    text = " ".join((folder / "README.md").read_text().split())
    assert "light change" not in text
    assert "90 frames in 2 rounds, 20 or 4 a second" in text
    assert "Frames of a drive are 1/20 or 1/4 s apart" in text


@pytest.mark.parametrize("driven", [True, False])
def test_rounds_without_a_drive_are_described_as_such(
    samples: Samples, tmp_path: Path, *, driven: bool
) -> None:
    folder = tmp_path / "data"
    prepare(folder)
    for name, trajectory in (("r000", PLACED), ("r001", "weave" if driven else PLACED)):
        lights = ("clear", "fog")
        header = samples.header(name, trajectory=trajectory, stretch=1, lights=lights)
        samples.add_round(folder, header)
    rebuild(folder, Split(("r000",), ("r001",)))
    text = " ".join((folder / "README.md").read_text().split())
    for sentence in (
        "In 1 of 2 rounds a scripted driver drives it;",
        "90 frames in 2 rounds, 20 a second, 56 x 42 px.",
        "Every frame the scenery, the weather and the light change, while the drive goes on",
        "Frames of a drive are 1/20 s apart and similar: use",
    ):
        assert (sentence in text) == driven
    assert ("scripted driver" in text) == driven
    assert f"In {1 if driven else 2} of 2 rounds (trajectory `placed`) the car stands still" in text
    assert "These frames have no order in time." in text
    assert ("Frames of a round show the same road: use" in text) == (not driven)
