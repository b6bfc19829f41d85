"""The page of an evaluation has the figures of the report, and shows the worst frames."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording import Dataset, Frames
from datagen.recording.names import PLACED
from mtlnet.data.description import mean_labels
from mtlnet.evaluation.html_report import (
    CAPTION_PX,
    MAX_ROUNDS,
    MIN_FRAMES_APART,
    SHEET_COLUMNS,
    WORST_PER_FEATURE,
    WorstFrame,
    page,
    worst_figures,
    worst_frames,
    write_worst_sheet,
)
from mtlnet.evaluation.metrics import evaluate_by_groups, signed_errors
from mtlnet.evaluation.tables import evaluation_table, protocol_table
from mtlnet.inference.overlay import PREDICTION_COLOUR, TRUTH_COLOUR, marking_line, to_pixels
from mtlnet.inference.prediction import FEATURES
from tests.mtlnet.conftest import HIGH_CAMERA, HIGH_ROUNDS, write_dataset
from tests.mtlnet.page import Page
from trackfeatures.camera import CameraParameters

ORDER = ("to_lane_centre", "angle", "ml", "mr", "m", "l", "r")
ERRORS_M = {9: 1.0, 30: -0.8, 60: 0.3}
"""Frames with this error of the predicted `ml`, m."""


@pytest.fixture(scope="module")
def frames(dataset: Path) -> Frames:
    return Dataset.open(dataset).select("all")


@pytest.fixture(scope="module")
def outputs(frames: Frames) -> NDArray[np.float32]:
    """Outputs with `ERRORS_M` and small errors on all frames; standard deviations 0.25 m or rad."""
    labels = frames.labels
    predicted = labels.distances.astype(np.float64)
    predicted[:, 0] -= 0.01
    for row, error in ERRORS_M.items():
        predicted[row, 0] = labels.distances[row, 0] + error
    coded = tf.encode(predicted, labels.angle + 0.002)
    classes = np.eye(3)[labels.heading] * 0.7 + 0.1
    uncertainty = np.full((len(frames), 8), 0.25)
    uncertainty[: len(frames) // 4, -1] = 2.0  # a quarter is out of distribution
    return np.concatenate([coded, classes, uncertainty], 1).astype(np.float32)


@pytest.fixture(scope="module")
def report(frames: Frames, outputs: NDArray[np.float32]) -> dict[str, Any]:
    return {
        "model": "a <model>",
        "model_hash": "0123456789abcdef" * 4,
        "engine": "openvino",
        "precision": "f32",
        "data": "some/data",
        "split": "all",
        "rounds": len(frames.rounds),
        **evaluate_by_groups(outputs, frames, mean_labels(frames.labels)),
    }


@pytest.fixture(scope="module")
def shown(report: dict[str, Any], frames: Frames, outputs: NDArray[np.float32]) -> Page:
    return Page(page(report, frames, outputs))


def test_the_page_needs_no_other_file(shown: Page) -> None:
    shown.require_self_contained()
    assert shown.all("title")[0].text == "a <model>: evaluation"
    assert "a &lt;model&gt;" in shown.source


def test_its_tables_are_those_of_the_report(shown: Page, report: dict[str, Any]) -> None:
    summary = shown.rows(0)
    assert [row[0] for row in summary[1:]] == [
        f"{name} ({'rad' if name == 'angle' else 'm'})" for name in FEATURES
    ]
    found = report["errors"]["ml"]
    assert summary[1][1:5] == [f"{found[k]:.3f}" for k in ("mean", "median", "p95", "p99")]
    assert summary[1][1:3] == [f"{found['mean']:.3f}", "0.010"]
    assert summary[7][1] == "0.0020"
    counted = shown.rows(1)
    totals = [sum(int(cell.split()[0]) for cell in row[1:] if cell != "-") for row in counted[1:]]
    assert sum(totals) == report["frames"]
    assert "100.00% right" in shown.source
    rates = report["presence"]["m"]
    assert None not in rates.values()
    shares = [f"{rates[kind]:.1%}" for kind in ("false_active", "false_inactive")]
    assert shown.rows(2)[4] == ["m", *shares]
    assert shown.rows(2)[1][:2] == ["ml", "-"]  # it is nowhere inactive
    coverage = shown.rows(3)
    assert coverage[7] == ["angle", "100.0%", "100.0%"]
    assert "25.0% of these frames are classified as out of distribution" in shown.source
    tracks = shown.rows(4)
    assert [row[:2] for row in tracks[1:]] == [["alpha", "48"], ["beta", "48"]]
    assert tracks[0][-1] == "out of distribution"


def test_rounds_that_every_leaves_without_frames_are_not_drawn(
    frames: Frames, outputs: NDArray[np.float32], report: dict[str, Any]
) -> None:
    few, found = frames.every(len(frames)), outputs[:1]
    figures = {**report, **evaluate_by_groups(found, few, mean_labels(few.labels))}
    assert len(Page(page(figures, few, found)).all("h3")) == 1


def test_a_round_of_each_track_is_drawn_with_its_band(shown: Page, frames: Frames) -> None:
    tracks = {info.track for info in frames.rounds}
    assert len(shown.all("h3")) == len(tracks) <= MAX_ROUNDS
    # Two charts a round: offset and angle, each with truth, prediction and two standard deviations.
    for kind in ("truth", "predicted", "band"):
        assert len(shown.all("path", kind)) == 2 * len(tracks)
    assert len(shown.all("path", "dot")) == sum(
        10 for name in FEATURES if name in ("ml", "mr", "to_lane_centre", "angle", "l", "m", "r")
    )


def test_placed_cars_are_not_drawn_as_a_drive(tmp_path: Path, report: dict[str, Any]) -> None:
    placed = Dataset.open(write_dataset(tmp_path, 300, trajectory=PLACED)).select("all")
    found = np.zeros((len(placed), 9), np.float32)
    about = {name: value for name, value in report.items() if name != "uncertainty"}
    figures = {**about, **evaluate_by_groups(found, placed, mean_labels(placed.labels))}
    assert not Page(page(figures, placed, found)).all("h3")


def test_the_worst_frames_are_the_worst() -> None:
    rng = np.random.default_rng(5)
    errors = rng.normal(size=(2000, 7))
    errors[rng.random(errors.shape) < 0.2] = np.nan
    errors[:, 3] = np.nan  # a feature never active
    rounds = np.repeat(np.arange(5), 400)
    chosen = worst_frames(errors, rounds)
    assert [w.feature for w in chosen] == [
        n for n in ORDER if n != FEATURES[3] for _ in range(WORST_PER_FEATURE)
    ]
    taken: list[WorstFrame] = []
    for one in chosen:
        column = FEATURES.index(one.feature)
        assert one.error == errors[one.row, column]
        # Every worse frame is too near to a frame that is shown already.
        for row in np.flatnonzero(np.abs(errors[:, column]) > abs(one.error)).tolist():
            assert any(
                abs(row - w.row) < MIN_FRAMES_APART and rounds[row] == rounds[w.row] for w in taken
            )
        assert not any(
            abs(one.row - w.row) < MIN_FRAMES_APART and rounds[one.row] == rounds[w.row]
            for w in taken
        )
        taken.append(one)


def test_the_worst_frames_are_shown_with_their_errors(
    shown: Page, frames: Frames, outputs: NDArray[np.float32]
) -> None:
    errors = signed_errors(outputs, frames.labels.distances, frames.labels.angle)
    chosen = worst_frames(errors, frames.labels.round)
    worst_ml = [w for w in chosen if w.feature == "to_lane_centre"]
    assert [w.row for w in worst_ml] == [9, 30]  # half of the error of `ml`, in rounds 0 and 1
    assert [w.error for w in worst_ml] == pytest.approx([0.5, -0.4], abs=1e-5)
    captions = [e.text for e in shown.all("figcaption") if "s =" in e.text]
    assert len(captions) == len(chosen) == len(shown.all("img"))
    assert captions[0].startswith("to_lane_centre +0.5 m, predicted standard deviation 0.25 m")
    assert "out of distribution" in captions[0]
    assert "out of distribution" not in captions[1]
    assert "r000, beta, s = 7 m" in captions[0]


@pytest.mark.parametrize("camera", [CameraParameters(), HIGH_CAMERA])
def test_markings_are_drawn_where_they_are(
    outputs: NDArray[np.float32], tmp_path: Path, camera: CameraParameters
) -> None:
    rounds = HIGH_ROUNDS if camera == HIGH_CAMERA else {}
    frames = Dataset.open(write_dataset(tmp_path, **rounds)).select("all")
    (figure,) = worst_figures(frames, outputs, [WorstFrame(9, "ml", 1.0)])
    pixels = figure["image"].astype(int)
    labels = frames.labels
    assert pixels.shape[0] == 2 * camera.height
    for distance, angle, colour in (
        (labels.distances[9, 0], labels.angle[9], TRUTH_COLOUR),
        (labels.distances[9, 0] + 1.0, labels.angle[9] + 0.002, PREDICTION_COLOUR),
    ):
        line = marking_line(float(distance), float(angle), float(labels.curvature[9]))
        points = to_pixels(line, camera)
        near = list(_inside(points, camera.width * 2, camera.height * 2))
        assert near
        for u, v in near:
            around = pixels[v - 1 : v + 2, u - 1 : u + 2].reshape(-1, 3)
            assert np.abs(around - colour).sum(1).min() < 150, (u, v, colour, around)


def _inside(points: NDArray[np.int32], width: int, height: int) -> Iterator[tuple[int, int]]:
    for u, v in points[: len(points) // 2].tolist():
        if 4 <= u < width - 4 and 4 <= v < height - 4:
            yield u, v


def test_a_marking_that_was_predicted_absent_has_no_deviation(
    frames: Frames, outputs: NDArray[np.float32]
) -> None:
    changed = outputs.copy()
    changed[9, :2] = 0.1, 0.9  # the inactive ends of `ml` and `mr`
    (figure,) = worst_figures(frames, changed, [WorstFrame(9, "ml", 3.0)])
    assert figure["note"].startswith(", predicted absent")


def test_the_sheet_of_worst_frames_shows_each_above_its_caption(
    frames: Frames, outputs: NDArray[np.float32], tmp_path: Path
) -> None:
    sheet = simplejpeg.decode_jpeg(
        write_worst_sheet(tmp_path / "worst.jpg", frames, outputs).read_bytes()
    )
    errors = signed_errors(outputs, frames.labels.distances, frames.labels.angle)
    chosen = worst_frames(errors, frames.labels.round)
    height, width = frames.camera.height, frames.camera.width
    tile = height + CAPTION_PX
    assert sheet.shape == (-(-len(chosen) // SHEET_COLUMNS) * tile, SHEET_COLUMNS * width, 3)
    for number, figure in enumerate(worst_figures(frames, outputs, chosen)):
        top, left = number // SHEET_COLUMNS * tile, number % SHEET_COLUMNS * width
        image = sheet[top : top + height, left : left + width].astype(float)
        expected = figure["image"][:, : 2 * width].reshape(height, 2, width, 2, 3).mean((1, 3))
        assert np.abs(image - expected).mean() < 8
        caption = sheet[top + height : top + tile, left : left + width]
        assert 0.005 < (caption < 128).mean() < 0.3


def test_page_and_tables_state_several_views(
    report: dict[str, Any], frames: Frames, outputs: NDArray[np.float32]
) -> None:
    text = "answers averaged over 2 views of each image"
    single = page({**report, "views": 1}, frames, outputs)
    assert single == page(report, frames, outputs)  # as of an evaluation before there were views
    assert text not in single
    several = {**report, "views": 2}
    assert page(several, frames, outputs) == single.replace(", f32<br>", f", f32, {text}<br>")
    assert str(evaluation_table(several).title) == f"{evaluation_table(report).title}, {text}"
    protocol = {**several, "protocol": {}}
    assert str(protocol_table(protocol).title).endswith(text)
    assert text not in str(protocol_table({**protocol, "views": 1}).title)
