"""Evaluation on labelled pictures: figures worked out by hand, and the page with failures first."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.data.custom_images import CustomImages, open_custom_images
from mtlnet.data.picture_copies import parse_copies
from mtlnet.evaluation.picture_page import cases, write_picture_page
from mtlnet.evaluation.pictures import Answers, judge, picture_report
from mtlnet.evaluation.tables import picture_table
from tests.mtlnet.page import Page
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

MEAN = {
    "distances_m": [-2.0, 2.0, None, None, None],
    "to_lane_centre_m": 0.0,
    "angle_rad": 0.0,
    "heading": 1,
}
HEAD = "file,ml,mr,l,m,r,angle,heading,drive,light,std_m,std_rad"
ROWS = (
    "a.png,-1.5,2.0,,,,0.02,straight,one,day,0.06,0.006",
    "b.png,-1.6,1.9,?,?,?,0.01,?,one,night,0.06,0.006",
    "c.png,-2.0,1.5,,,,-0.03,?,two,day,0.08,0.002",
)
ANSWERED = np.array([[-1.6, 2.2], [-1.6, 2.0], [np.nan, np.nan]])
ANGLES = np.array([0.025, 0.01, -0.05])
STD = 0.081


@pytest.fixture
def images(tmp_path: Path) -> CustomImages:
    (tmp_path / "labels.csv").write_text("\n".join([HEAD, *ROWS]) + "\n")
    for level, name in enumerate("abc"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((420, 560, 3), 90 + level, np.uint8))
    return open_custom_images(tmp_path, CameraParameters())


def outputs() -> NDArray[np.float32]:
    """Outputs (3, 17): the answers above, straight ahead; the second is out of distribution."""
    distances = np.full((3, 5), np.nan)
    distances[:, :2] = ANSWERED
    coded = tf.encode(distances, ANGLES)
    heading = np.tile([0.1, 0.8, 0.1], (3, 1))
    std = np.tile([*[STD] * 6, 0.008], (3, 1))
    ood = np.array([[0.5], [1.5], [0.2]])
    return np.concatenate([coded, heading, std, ood], 1).astype(np.float32)


def judged(images: CustomImages) -> Answers:
    return judge(images, outputs(), [images.hashes[1]])


def test_figures_equal_those_by_hand(images: CustomImages) -> None:
    report = picture_report(judged(images), MEAN)
    figures = report["pictures"]
    assert (figures["files"], figures["cases"], figures["refused"]) == (3, 3, 0)
    assert (figures["absent"], figures["out_of_distribution"]) == (1, 1)
    mean = {"ml": 0.05, "mr": 0.15, "lane_width": 0.2, "to_lane_centre": 0.05}
    for name, value in mean.items():
        assert figures["mean"][name] == pytest.approx(value, abs=1e-5), name
        assert figures["median"][name] == pytest.approx(value, abs=1e-5), name  # of two
    assert figures["mean"]["angle"] == pytest.approx((0.005 + 0.0 + 0.02) / 3, abs=1e-6)
    assert figures["median"]["angle"] == pytest.approx(0.005, abs=1e-6)
    # Drive one: 0.0025 of two, drive two: 0.02 of one.
    assert figures["mean_of_drives"]["angle"] == pytest.approx(0.01125, abs=1e-6)
    # Medians of the labels: -1.6, 1.9, 0.01.
    assert figures["always_median"]["ml"] == pytest.approx((0.1 + 0 + 0.4) / 3, abs=1e-6)
    assert figures["always_median"]["angle"] == pytest.approx((0.01 + 0 + 0.04) / 3, abs=1e-6)
    # mr: 0.2 beyond, 0.1 within hypot(0.081, 0.06) = 0.1008; c absent: the
    # value behind it, 3.5 m away. Angle: 0.005 and 0 within hypot(0.008, 0.006), 0.02 not.
    assert figures["within_std"]["angle"] == pytest.approx(2 / 3)
    assert figures["within_std"]["mr"] == pytest.approx(1 / 3)
    assert report["uncertainty"]["coverage"]["mr"][1] == pytest.approx(2 / 3)  # 0.2 too
    assert figures["label_std"]["m"] == pytest.approx(0.2 / 3)
    assert report["heading_accuracy"] == 1.0  # of the one that is known
    assert report["presence"]["m"] == {"false_inactive": None, "false_active": 0.0}
    assert list(figures["by_drive"]) == ["one", "two"]
    assert figures["by_drive"]["one"]["mean"]["angle"] == pytest.approx(0.0025, abs=1e-6)
    assert figures["by_light"]["night"]["out_of_distribution"] == 1
    assert {k: v["cases"] for k, v in figures["by_training"].items()} == {
        "not trained on": 2,
        "trained on": 1,
    }
    fresh = picture_report(judge(images, outputs()), MEAN)["pictures"]
    assert "by_training" not in fresh


def test_refused_pictures_count_in_their_groups(images: CustomImages) -> None:
    refused = replace(images.take([0, 1]), refused=((images.pictures[2], "plain", "too narrow"),))
    answers = judge(refused, outputs()[:2])
    figures = picture_report(answers, MEAN)["pictures"]
    assert (figures["cases"], figures["refused"], figures["files"]) == (3, 1, 3)
    assert figures["by_drive"]["two"]["refused"] == figures["by_drive"]["two"]["cases"] == 1
    assert figures["by_drive"]["two"]["mean"]["ml"] is None
    assert next(case.verdict for case in cases(answers)) == "refused: too narrow"


def test_a_drive_with_the_name_of_a_copy_hides_no_other(images: CustomImages) -> None:
    names = {"one": "plain"}
    named = (replace(p, drive=names.get(p.drive, p.drive)) for p in images.pictures)
    figures = picture_report(judged(replace(images, pictures=tuple(named))), MEAN)["pictures"]
    assert {k: v["cases"] for k, v in figures["by_drive"].items()} == {"plain": 2, "two": 1}


def test_the_page_shows_each_picture_failures_first(images: CustomImages, tmp_path: Path) -> None:
    answers = judged(images)
    assert [(case.picture.file, case.verdict) for case in cases(answers)] == [
        ("c.png", "answered absent"),
        ("a.png", ""),
        ("b.png", "out of distribution"),
    ]
    about = {"model": "m", "model_hash": "0" * 64, "engine": "e", "precision": "f32", "data": "x"}
    report = {**about, **picture_report(answers, MEAN)}
    path = write_picture_page(tmp_path / "page.html", report, answers)
    page = Page(path.read_text(encoding="utf-8"))
    page.require_self_contained()
    assert len(page.all("figure")) == len(page.all("img")) == 3
    assert page.rows(0)[1][1:] == ["0.050", "0.150", "0.200", "0.050", "0.0083"]
    assert "trained on some of these pictures" in page.source
    assert page.rows(1)[2] == ["answered absent: the lane is labelled", "1", "33.3%"]
    several = {**report, "views": 6}
    write_picture_page(path, several, answers)
    text = "answers averaged over 6 views of each image"
    assert path.read_text(encoding="utf-8") == page.source.replace("f32<br>", f"f32, {text}<br>")
    assert f"{picture_table(report).title}, {text}" == picture_table(several).title


def test_copies_are_named() -> None:
    assert parse_copies("") == ("plain",)
    assert parse_copies("turned, mirrored") == ("plain", "mirrored", "turned left", "turned right")
    with pytest.raises(UserError, match="--copies has 'upside'; give some of mirrored, turned"):
        parse_copies("mirrored,upside")
