"""The metrics of `mtlnet evaluate` on four frames against numbers worked out by hand."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

import trackfeatures as tf
from datagen.recording import Labels
from mtlnet.evaluation.metrics import GROUPS, evaluate_by_groups, evaluate_outputs, presence
from tests.datagen.recording.labels import labels_of

NAN = float("nan")
TRUE = [
    [-2.0, 2.0, NAN, NAN, NAN],
    [-1.0, 3.0, NAN, -1.0, 3.0],
    [NAN, NAN, -3.8, 0.2, 4.2],
    [-2.5, 1.5, NAN, NAN, NAN],
]
PREDICTED = [
    [-2.1, 2.1, NAN, NAN, NAN],
    [-1.0, 3.3, NAN, -0.8, 3.0],
    [NAN, NAN, -3.8, 0.3, 4.1],
    [-2.5, 1.5, NAN, 2.0, NAN],
]
ANGLE, PREDICTED_ANGLE = [0.0, 0.1, -0.1, 0.0], [0.02, 0.1, -0.12, 0.0]
HEADING = np.array([0, 1, 2, 1])
PROBABILITIES = [[0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.6, 0.2, 0.2], [0.2, 0.5, 0.3]]
MEAN = {
    "distances_m": [-2.0, 2.0, -4.0, 0.0, 4.0],
    "to_lane_centre_m": 0.0,
    "angle_rad": 0.0,
    "heading": 1,
}


def labels() -> Labels:
    return labels_of(4, distances=TRUE, angle=np.array(ANGLE, np.float32), heading=HEADING)


OUTPUTS = np.concatenate(
    [tf.encode(PREDICTED, PREDICTED_ANGLE), np.array(PROBABILITIES, np.float32)], axis=1
)


def test_errors_are_taken_on_active_labels() -> None:
    report = evaluate_outputs(OUTPUTS, labels(), MEAN)
    assert report["frames"] == 4
    expected = {"ml": 0.1 / 3, "mr": 0.4 / 3, "l": 0.0, "m": 0.3 / 2, "r": 0.1 / 2}
    assert report["mae_m"] == pytest.approx(expected, abs=1e-5)
    # Offsets: predicted 0, 1.15, 0.3 - 3.8 halved, -0.5; true 0, 1, 0.2 - 3.8 halved, -0.5.
    assert report["to_lane_centre_mae_m"] == pytest.approx((0.15 + 0.05) / 4, abs=1e-5)
    assert report["angle_mae_rad"] == pytest.approx(0.04 / 4, abs=1e-6)
    assert report["heading_accuracy"] == 0.75


def test_the_baseline_predicts_the_training_mean() -> None:
    report = evaluate_outputs(OUTPUTS, labels(), MEAN)
    base = report["baseline"]
    expected = {"ml": 1.5 / 3, "mr": 1.5 / 3, "l": 0.2, "m": 1.2 / 2, "r": 1.2 / 2}
    assert base["mae_m"] == pytest.approx(expected, abs=1e-5)
    assert base["angle_mae_rad"] == pytest.approx(0.05, abs=1e-6)
    assert base["heading_accuracy"] == 0.5
    assert report["ratio"]["mae_m"]["ml"] == pytest.approx(0.1 / 1.5, abs=1e-4)
    assert report["ratio"]["angle_mae_rad"] == pytest.approx(0.2, abs=1e-4)


def test_coded_losses_are_those_of_training() -> None:
    coded = evaluate_outputs(OUTPUTS, labels(), MEAN)["coded"]
    in_lane, on_marking = 0.8 / 5.0, 0.8 / 5.5
    squares = [
        2 * (0.1 * in_lane) ** 2,
        (0.3 * in_lane) ** 2 + (0.2 * on_marking) ** 2,
        2 * (0.1 * on_marking) ** 2,
        ((3.5 - 2.0) * on_marking) ** 2,
    ]
    assert coded["distance"] == pytest.approx(sum(squares) / 4, rel=1e-4)
    assert coded["angle"] == pytest.approx(2 * (0.02 * 0.8) ** 2 / 4, rel=1e-4)
    likelihood = 0.8 * 0.8 * 0.2 * 0.5
    assert coded["type"] == pytest.approx(-math.log(likelihood) / 4, rel=1e-5)


def test_presence_counts_false_inactive_and_false_active() -> None:
    counted = presence(OUTPUTS, labels())
    assert counted["m"] == {"false_inactive": 0.0, "false_active": 0.5}
    assert counted["ml"] == {"false_inactive": 0.0, "false_active": 0.0}
    without_m = OUTPUTS.copy()
    without_m[2, 3] = 0.9  # decodes to the inactive end
    assert presence(without_m, labels())["m"]["false_inactive"] == 0.5
    # The error is still taken, on the value given: 3.5 m instead of 0.2 m.
    error = evaluate_outputs(without_m, labels(), MEAN)["mae_m"]["m"]
    assert error == pytest.approx((3.3 + 0.2) / 2, abs=1e-4)


def test_the_error_of_a_feature_that_is_never_active_is_none() -> None:
    only = labels().take(np.array([0]))
    report = evaluate_outputs(OUTPUTS[:1], only, MEAN)
    assert report["mae_m"]["l"] is None
    assert report["ratio"]["mae_m"]["l"] is None


def many(count: int) -> tuple[np.ndarray, Labels]:
    """Outputs (N, 17) with known errors, and labels of every group."""
    rng = np.random.default_rng(4)
    column = rng.uniform(-1.4, 1.4, (count, 1)).astype(np.float32)
    absent = np.full((count, 3), np.nan, np.float32)
    distances = np.concatenate([column - 2, column + 2, absent], 1)
    angle = rng.uniform(-0.1, 0.1, count).astype(np.float32)
    error = rng.normal(0.0, 0.05, (count, 2))
    predicted = distances.astype(np.float64)
    predicted[:, :2] += error
    coded = tf.encode(predicted, angle + 0.01)
    uncertainty = np.tile([0.05] * 5 + [0.05 / 2**0.5, 0.02, 0.5], (count, 1))
    outputs = np.concatenate([coded, np.tile([0.2, 0.5, 0.3], (count, 1)), uncertainty], 1)
    lanes = rng.integers(1, 4, count)
    found = labels_of(
        count,
        distances=distances,
        angle=angle,
        heading=rng.integers(0, 3, count),
        lanes=lanes,
        curvature=rng.uniform(-0.04, 0.04, count).astype(np.float32),
        to_lane_centre=column[:, 0],
        speed=rng.uniform(5, 25, count).astype(np.float32),
        shadow_fraction=rng.uniform(0, 1, count).astype(np.float32),
        light=rng.choice(["fog", "rain"], count),
        round=rng.integers(0, 2, count),
    )
    return outputs.astype(np.float32), found


class FakeFrames:
    """Labels and tracks of two rounds."""

    def __init__(self, labels: Labels) -> None:
        self.labels = labels
        self.rounds = [
            SimpleNamespace(track=track, track_group=track) for track in ("oval", "town")
        ]


def test_percentiles_equal_those_of_numpy() -> None:
    outputs, found = many(500)
    spread = evaluate_outputs(outputs, found, MEAN)["errors"]
    error = np.abs(tf.decode_values(outputs[:, :6])[:, 0] - found.distances[:, 0])
    for name, share in (("median", 50), ("p95", 95), ("p99", 99)):
        assert spread["ml"][name] == pytest.approx(np.percentile(error, share))
    assert spread["ml"]["mean"] == evaluate_outputs(outputs, found, MEAN)["mae_m"]["ml"]
    assert spread["angle"]["p99"] == pytest.approx(0.01, abs=1e-5)
    assert spread["m"] == {"mean": None, "median": None, "p95": None, "p99": None, "frames": 0}


def test_groups_sum_to_the_whole() -> None:
    outputs, found = many(600)
    report = evaluate_by_groups(outputs, FakeFrames(found), MEAN)  # type: ignore[arg-type]
    for way in GROUPS:
        parts = report[way].values()
        assert sum(part["frames"] for part in parts) == 600
        assert len(parts) > 1
        mean = sum(part["errors"]["mr"]["mean"] * part["frames"] for part in parts) / 600
        assert mean == pytest.approx(report["mae_m"]["mr"])
        for true, row in report["confusion"].items():
            for predicted, count in row.items():
                assert sum(part["confusion"][true][predicted] for part in parts) == count
    assert list(report["by_speed"]) == [
        "under 30 km/h", "30 to 45 km/h", "45 to 60 km/h", "over 60 km/h",
    ]  # fmt: skip
    slow = (found.speed * 3.6 < 30).sum()
    assert report["by_speed"]["under 30 km/h"]["frames"] == slow


def test_coverage_and_calibration_of_the_standard_deviations() -> None:
    outputs, found = many(2000)
    uncertainty = evaluate_by_groups(outputs, FakeFrames(found), MEAN)["uncertainty"]  # type: ignore[arg-type]
    assert uncertainty["coverage"]["ml"][0] == pytest.approx(0.683, abs=0.03)
    assert uncertainty["coverage"]["to_lane_centre"][1] == pytest.approx(0.954, abs=0.02)
    assert uncertainty["coverage"]["angle"] == [1.0, 1.0]
    assert uncertainty["coverage"]["l"] == [None, None]
    assert uncertainty["out_of_distribution"] == 0.0
    assert sum(part["frames"] for part in uncertainty["calibration"]["ml"]) == 2000
    outputs[:500, -1] = 1.5
    assert evaluate_outputs(outputs, found, MEAN)["uncertainty"]["out_of_distribution"] == 0.25
