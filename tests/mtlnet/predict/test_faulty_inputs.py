"""`mtlnet predict` on damaged and missing inputs: all other images are answered."""

import csv
import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from mtlnet.predict.run import InputsLeftOut, predict_files
from tests.mtlnet.conftest import write_dataset, write_round
from tests.mtlnet.predict.brightness_engine import BrightnessEngine, write_jpeg
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError


def test_one_input_that_cannot_be_read_costs_no_other(
    engine: BrightnessEngine, dataset: Path, tmp_path: Path
) -> None:
    """A damaged, a truncated, a foreign and another camera's round, a missing file, a wrong
    pattern."""
    source = sorted((dataset / "rounds").glob("*.mcap"))[0]
    (tmp_path / "cut.mcap").write_bytes(source.read_bytes()[:5000])
    (tmp_path / "none.mcap").write_bytes(b"no round")
    (tmp_path / "other").mkdir()
    write_dataset(tmp_path / "other", camera=replace(CameraParameters(), z=2.0))
    bad = ["cut.mcap", "none.mcap", "missing.jpg", "*.tif", "**x", "pipe.jpg", "broken.mp4"]
    os.mkfifo(tmp_path / "pipe.jpg")
    (tmp_path / "broken.mp4").write_bytes(b"no film")
    good = write_jpeg(tmp_path / "good.jpg", 90)
    given = [*(str(tmp_path / name) for name in bad), str(good)]
    given.append(str(sorted((tmp_path / "other" / "rounds").glob("*.mcap"))[0]))
    table = tmp_path / "rows.csv"
    notes: list[str] = []
    with pytest.raises(UserError, match=r"cut\.mcap is damaged .* \(and 7 more\); 1 image done"):
        predict_files(engine, given, [table], note=notes.append)
    with table.open(newline="") as file:
        assert [row["image"] for row in csv.DictReader(file)] == [str(good)]
    assert len(notes) == len(bad)  # the other camera is found when the round is read
    assert "there is no image file" in notes[2]


def test_a_damaged_chunk_of_a_round_costs_its_frames_only(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    (tmp_path / "rounds").mkdir()
    for number in range(2):  # each is one chunk of 24 frames
        write_round(tmp_path, f"r00{number}", number)
    bad, good = sorted((tmp_path / "rounds").glob("*.mcap"))
    content = bytearray(bad.read_bytes())
    content[len(content) // 2] ^= 1
    bad.write_bytes(content)
    table = tmp_path / "rows.jsonl"
    message = rf"image 0 of .*{bad.name} cannot be read: the chunk at byte \d+ is damaged"
    with pytest.raises(UserError, match=rf"{message}.*and 23 more\); 24 images done"):
        predict_files(engine, [str(bad), str(good)], [table])
    rows = [json.loads(line) for line in table.read_text().splitlines()]
    assert [row["image"] for row in rows] == [f"{good}#{n}" for n in range(24)]


def test_without_a_usable_image_earlier_files_are_kept(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    image = tmp_path / "a.png"
    image.write_bytes(b"no picture")
    outputs = [tmp_path / f"old{suffix}" for suffix in (".csv", ".jsonl", ".mp4", ".mcap")]
    for path in outputs:
        path.write_text("yesterday")
    with pytest.raises(InputsLeftOut, match=r"a\.png"):
        predict_files(engine, [str(image)], [*outputs, tmp_path / "drawn"])
    assert [path.read_bytes() for path in outputs] == [b"yesterday"] * len(outputs)
    assert {path.name for path in tmp_path.iterdir()} == {"a.png", *(p.name for p in outputs)}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("rows.txt", r"give a file ending in \.csv"),
        ("none/rows.csv", "there is no folder"),
        ("folder.csv", "is a folder"),
        ("a.png/drawn", "there is no folder"),
        ("file", "is a file; give a folder for pictures"),
    ],
)
def test_an_output_that_cannot_be_written_is_refused_before_the_first_image(
    engine: BrightnessEngine, tmp_path: Path, name: str, message: str
) -> None:
    image = write_jpeg(tmp_path / "a.png", 10)
    (tmp_path / "folder.csv").mkdir()
    (tmp_path / "file").write_text("kept")
    with pytest.raises(UserError, match=message):
        predict_files(engine, [str(image)], [tmp_path / name])
    assert engine.seen == []
