"""`datagen stats`: the counts, concerns and frames of its page."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from datagen.cli import app
from datagen.recording.dataset import Dataset
from datagen.recording.statistics import describe
from datagen.stats.contact_sheet import contact_sheet
from datagen.stats.page import concerns, page
from runtime.svg_charts import BINS, FOOT, HEIGHT, histogram


def test_the_page_needs_no_other_file_and_counts_the_frames(dataset: Path) -> None:
    text = page(Dataset.open(dataset))
    assert not re.search(r'(src|href)="(?!data:)', text)
    assert "135 frames in 3 rounds, 56 x 42 px" in text
    assert "90 / 45" in text  # frames of the one track, train and test
    assert text.count("data:image/jpeg;base64,") == 3
    assert text.count("<polygon") == 2 * 11


def test_a_histogram_counts_each_bin() -> None:
    left, right = np.full(30, -1.0, np.float32), np.full(10, 1.0, np.float32)
    drawn = histogram("x", "m", {"train": np.concatenate([left, right]), "test": right[:0]})
    first = re.search(r'points="([^"]+)"', drawn)
    assert first is not None
    heights = [HEIGHT - FOOT - float(p.split(",")[1]) for p in first[1].split()][1:-1:2]
    assert len(heights) == BINS
    assert heights[0] == pytest.approx(3 * heights[-1], rel=0.01)
    assert all(height == 0 for height in heights[1:-1])


def test_a_histogram_of_a_feature_that_is_never_active_is_a_note() -> None:
    absent = np.full(5, np.nan, np.float32)
    assert "never active" in histogram("l", "m", {"train": absent, "test": absent})


def test_rare_classes_empty_splits_and_one_sided_tracks_are_concerns(dataset: Path) -> None:
    opened = Dataset.open(dataset)
    statistics = describe(opened)
    statistics["train"]["heading"]["left"] = 0.149
    statistics["train"]["heading"]["right"] = 0.15
    statistics["test"]["active"]["l"] = 0.019
    elsewhere = [replace(opened.rounds[0], track="hill"), *opened.rounds[1:]]
    found = "\n".join(concerns(statistics, elsewhere))
    assert "Class left has 14.9% of the train frames" in found
    assert "Class right has" not in found.replace("of the test", "")
    assert "l is active in 1.9% of the test frames" in found
    assert "Track hill: in train rounds only, in no test round." in found
    assert "Light" not in found
    statistics["test"] = {"frames": 0}
    assert "No round is for test" in "\n".join(concerns(statistics, elsewhere))


def test_the_contact_sheet_shows_other_tracks_and_lights_first(dataset: Path) -> None:
    opened = Dataset.open(dataset)
    opened.rounds[2] = replace(opened.rounds[2], track="hill")
    cards = list(contact_sheet(opened, most=2))
    assert [card.about.split(" ")[0] for card in cards] == ["r000", "r002"]
    assert "hill, 2 lanes, clear" in cards[1].about
    assert cards[0].image.shape == (84, 112, 3)
    assert re.search(r"rad \| (left|straight|right)", cards[0].caption)
    green = (cards[0].image[..., 1] > 200) & (cards[0].image[..., 0] < 120)
    assert green.sum() > 20  # the recorded markings


def test_the_command_writes_the_page_and_prints_its_figures(dataset: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["stats", str(dataset), "--json"])
    assert done.exit_code == 0
    result = json.loads(done.stdout)
    assert result["frames"] == 135
    assert Path(result["page"]) == dataset / "stats.html"
    assert "<h2>Distributions</h2>" in (dataset / "stats.html").read_text()
    elsewhere = CliRunner().invoke(
        app, ["stats", str(dataset), "--out", str(tmp_path / "no" / "x")]
    )
    assert elsewhere.exit_code != 0
    assert "there is no folder" in str(elsewhere.exception)
