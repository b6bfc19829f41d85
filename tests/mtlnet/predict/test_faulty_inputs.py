"""`mtlnet predict` on damaged and missing inputs: all other images are answered."""

import csv
import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mtlnet.predict.run import predict_files
from tests.mtlnet.conftest import write_dataset, write_round
from tests.mtlnet.predict.brightness_engine import BrightnessEngine, write_film, write_jpeg
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError


def test_a_cut_film_keeps_what_was_read(engine: BrightnessEngine, tmp_path: Path) -> None:
    whole = tmp_path / "whole.avi"
    writer = cv2.VideoWriter(str(whole), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (560, 420))
    rng = np.random.default_rng(0)
    for _ in range(10):
        writer.write(rng.integers(0, 256, (420, 560, 3), dtype=np.uint8))
    writer.release()
    cut = tmp_path / "cut.avi"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    table = tmp_path / "rows.jsonl"
    with pytest.raises(
        UserError, match=r"cut\.avi ends after \d of 10 frames; these frames were used .it breaks"
    ):
        predict_files(engine, [str(cut)], [table])
    rows = table.read_text().splitlines()
    assert 2 <= len(rows) < 10


def test_a_film_that_cannot_be_opened_loses_no_other_file(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    broken, table = tmp_path / "broken.mp4", tmp_path / "rows.jsonl"
    broken.write_bytes(b"no film")
    film = write_film(tmp_path / "film.mp4", [10, 200])
    with pytest.raises(UserError, match=r"broken.mp4 cannot be opened as a film.*2 images done"):
        predict_files(engine, [str(broken), str(film)], [table])
    assert len(table.read_text().splitlines()) == 2


def test_a_damaged_image_does_not_stop_the_others(engine: BrightnessEngine, tmp_path: Path) -> None:
    write_jpeg(tmp_path / "a.jpg", 10)
    (tmp_path / "b.jpg").write_text("no image")
    write_jpeg(tmp_path / "c.jpg", 200)
    table = tmp_path / "rows.csv"
    with pytest.raises(UserError, match=r"b\.jpg: no image file.*; 2 images done"):
        predict_files(engine, [str(tmp_path)], [table])
    assert [line.split(",")[0][-5:] for line in table.read_text().splitlines()[1:]] == [
        "a.jpg",
        "c.jpg",
    ]


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
