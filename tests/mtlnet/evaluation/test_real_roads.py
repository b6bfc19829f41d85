"""`mtlnet evaluate` on the imported real roads gives the figures of the pictures' own evaluation
program. Skipped without the pictures, which are in $DRIVERVIEW_REAL_ROADS or next to
$TORCS_TRACKS."""

import contextlib
import csv
import io
import json
import os
import runpy
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mtlnet.data import picture_copies
from mtlnet.evaluation.evaluate import evaluate
from mtlnet.inference.engine import load_engine
from mtlnet.inference.model_card import resolve_run
from mtlnet.label.import_table import import_labels, parse_label_std
from trackfeatures.camera import CameraParameters

NAMES = {
    "x_left": "ml",
    "x_right": "mr",
    "width": "lane_width",
    "centre": "to_lane_centre",
    "angle": "angle",
}


def _folder() -> Path | None:
    named, tracks = os.environ.get("DRIVERVIEW_REAL_ROADS"), os.environ.get("TORCS_TRACKS")
    folder = Path(named) if named else Path(tracks).parent / "real_roads" if tracks else None
    return folder if folder is not None and (folder / "judge.py").is_file() else None


FOLDER = _folder()
pytestmark = pytest.mark.skipif(FOLDER is None, reason="no real roads: set DRIVERVIEW_REAL_ROADS")


@pytest.fixture(autouse=True)
def _turned_as_by_the_judge(monkeypatch: pytest.MonkeyPatch) -> None:
    """Turn pictures about the camera's own vertical axis, as the pictures' own program does. For a
    pitch of 3 degrees the distances in the turned copies are then wrong by up to 14 mm."""
    turned = picture_copies._turned

    def judges(image: Any, *cameras: CameraParameters) -> Any:
        return turned(image, *(replace(c, pitch_deg=0.0, roll_deg=0.0) for c in cameras))

    monkeypatch.setattr(picture_copies, "_turned", judges)


def compare(folder: Path, tmp_path: Path, *options: str) -> None:
    """Evaluate the pictures of a table with its own program and with ours, with all copies."""
    assert FOLDER is not None
    cases, printed = tmp_path / "cases.json", io.StringIO()
    arguments = ["judge.py", str(folder), "default", "--json", str(cases), *options]
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(sys, "argv", arguments)
        runpy.run_path(str(FOLDER / "judge.py"))
    text = printed.getvalue()
    judged: dict[str, Any] = json.loads(text[: text.index("}") + 1])
    stds = parse_label_std(["0.06,0.006", "comma10k_*=0.16,0.012"])
    import_labels(folder / "labels.csv", tmp_path / "mine", stds)
    engine = load_engine(resolve_run("default"), precision="f32", threads=1)
    figures = evaluate([engine], tmp_path / "mine", "all", copies="mirrored,turned")["pictures"]
    assert figures["cases"] == judged["cases"] == 4 * judged["images"]
    assert figures["refused"] == judged["refused"]
    assert figures["absent"] == judged["ml_absent"]
    assert figures["out_of_distribution"] == judged["ood"]
    mean = "mean" if "--flat" in options else "mean_of_drives"
    for theirs, ours in NAMES.items():
        found = [figures[mean][ours], figures["median"][ours]]
        np.testing.assert_allclose(found, judged[theirs], atol=1e-3, err_msg=theirs)


def test_figures_equal_those_of_the_judge(tmp_path: Path) -> None:
    """On three pictures of two cameras and two drives."""
    assert FOLDER is not None
    few = tmp_path / "few"
    few.mkdir()
    with (FOLDER / "labels.csv").open(newline="") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
    chosen = [*rows[:2], next(row for row in rows if row["file"].startswith("comma10k"))]
    with (few / "labels.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, reader.fieldnames or ())
        writer.writeheader()
        writer.writerows(chosen)
    for row in chosen:
        shutil.copyfile(FOLDER / row["file"], few / row["file"])
    compare(few, tmp_path)


@pytest.mark.extended
def test_figures_of_all_pictures_equal_those_of_the_judge(tmp_path: Path) -> None:
    assert FOLDER is not None
    compare(FOLDER, tmp_path, "--flat")
