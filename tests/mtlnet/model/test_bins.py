"""Answers as distributions over bins: targets, answers from scores, learning."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.architecture import ABSENT_ABOVE, ANGLE_BINS, DISTANCE_BINS, GRID, grid_size
from mtlnet.export.convert import ONNX_FILE, check_export, write_onnx
from mtlnet.inference.engine import openvino_core, run_graph
from mtlnet.inference.prediction import OUTPUTS, decode_outputs, split_outputs
from mtlnet.model.bins import (
    Scores,
    absent_in,
    bin_targets,
    expectation,
    log_spreads,
    normal_targets,
    read_scores,
)
from mtlnet.model.network import Network, fold, initialise, predict_images
from mtlnet.model.openvino_graph import TOLERANCE, build_feature_graph, build_graph
from mtlnet.model.served import FitInputs
from mtlnet.training.losses.bins import bins_loss
from mtlnet.training.losses.multi_task import Losses
from mtlnet.training.losses.task_weighting import TaskWeighting

NAN = float("nan")
CASES = [
    # In a lane; on a marking between two lanes; on both systems at once; outside on the left.
    ((-1.9, 2.1, NAN, NAN, NAN), 0.03),
    ((NAN, NAN, -3.7, 0.3, 4.3), -0.12),
    ((-0.8, 3.2, NAN, -0.8, 3.2), 0.3),
    ((NAN, NAN, NAN, 1.5, 5.4), 0.0),
]


def absent_of(network: Network, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Probabilities of absence (N, 5) in torch."""
    with torch.inference_mode():
        x = network.forward_features(torch.from_numpy(frames))
        return network.absent_probabilities(x).numpy()


def coded_cases() -> torch.Tensor:
    return torch.from_numpy(tf.encode([d for d, _ in CASES], [a for _, a in CASES]))


def test_a_target_is_a_normal_distribution_over_its_bins() -> None:
    found = normal_targets(torch.tensor([0.0, 0.05, -7.0]), -1.0, 1.0, 20).numpy()
    np.testing.assert_allclose(found.sum(1), 1.0, atol=1e-6)
    middles = np.linspace(-0.95, 0.95, 20)
    # Standard deviation of a bin, and Sheppard's correction for its width.
    for row, value in ((0, 0.0), (1, 0.05)):
        mean = (found[row] * middles).sum()
        assert mean == pytest.approx(value, abs=1e-4)
        assert (found[row] * (middles - mean) ** 2).sum() == pytest.approx(0.01 * 13 / 12, rel=1e-3)
    assert found[2].argmax() == 0  # a value outside counts as the nearer end


def test_labels_say_what_is_absent() -> None:
    expected = [[np.isnan(d) for d in distances] for distances, _ in CASES]
    assert absent_in(coded_cases()).tolist() == expected
    mirrored = torch.from_numpy(tf.mirror_coded(coded_cases().numpy()))
    swapped = [[row[i] for i in (1, 0, 4, 3, 2)] for row in expected]
    assert absent_in(mirrored).tolist() == swapped


def test_what_is_read_from_a_target_is_its_value() -> None:
    coded = coded_cases()
    distances, angles = bin_targets(coded)
    assert (distances.shape, angles.shape) == ((4, 5, DISTANCE_BINS + 1), (4, ANGLE_BINS))
    read = read_scores(distances.clamp_min(1e-9).log(), angles.clamp_min(1e-9).log())
    np.testing.assert_allclose(read.numpy(), coded.numpy(), atol=4e-4)
    found, angle = tf.decode(read.numpy())
    np.testing.assert_allclose(found, [d for d, _ in CASES], atol=3e-3)
    np.testing.assert_allclose(angle, [a for _, a in CASES], atol=5e-4)


def test_of_two_peaks_the_higher_is_the_answer() -> None:
    both = 0.6 * normal_targets(torch.tensor(-3.0), -5.0, 0.0, DISTANCE_BINS)
    both += 0.4 * normal_targets(torch.tensor(-1.0), -5.0, 0.0, DISTANCE_BINS)
    share = float(expectation(both.clamp_min(1e-9).log()))
    assert -5.0 + 5.0 * share == pytest.approx(-3.0, abs=0.01)


def test_the_spread_of_two_peaks_is_their_distance() -> None:
    width = 5.0 / DISTANCE_BINS
    one = normal_targets(torch.tensor(-3.0), -5.0, 0.0, DISTANCE_BINS)
    both = 0.5 * one + 0.5 * normal_targets(torch.tensor(-1.0), -5.0, 0.0, DISTANCE_BINS)
    scores = torch.zeros(1, 5, DISTANCE_BINS + 1)
    scores[0, 0, :-1], scores[0, 1, :-1] = one.clamp_min(1e-9).log(), both.clamp_min(1e-9).log()
    scores[0, :, -1] = 5.0  # the probability of "absent" does not matter
    spread = np.exp(log_spreads(scores, torch.zeros(1, ANGLE_BINS)).numpy()[0])
    assert spread[0] == pytest.approx(1.0, abs=0.1)
    assert spread[1] * width == pytest.approx(1.0, abs=0.02)
    assert spread[5] == pytest.approx(ANGLE_BINS / 12**0.5, rel=1e-3)  # a uniform distribution


def test_both_markings_of_the_lane_are_absent_together() -> None:
    scores = torch.zeros(2, 5, DISTANCE_BINS + 1)
    scores[:, 0, 45] = scores[:, 1, 20] = scores[:, 2:, 30] = 8.0
    scores[0, 0, DISTANCE_BINS], scores[1, 0, DISTANCE_BINS] = (
        7.0,
        12.0,
    )  # a little unsure, and quite sure
    distances, _ = tf.decode(read_scores(scores, torch.zeros(2, ANGLE_BINS)).numpy())
    assert np.isnan(distances[:, :2]).tolist() == [[False, False], [False, False]]
    scores[1, 1, DISTANCE_BINS] = 7.99  # the mean of both probabilities is above a half
    distances, _ = tf.decode(read_scores(scores, torch.zeros(2, ANGLE_BINS)).numpy())
    assert np.isnan(distances[:, :2]).tolist() == [[False, False], [True, True]]


@pytest.mark.parametrize(
    ("probability", "absent"),
    [
        (0.5, [False, False, False, False, False]),
        (0.7, [True, True, False, True, False]),
        (0.8, [True, True, True, True, True]),
    ],
)
def test_the_outer_markings_are_absent_above_a_higher_probability(
    probability: float, absent: list[bool]
) -> None:
    scores = torch.full((1, 5, DISTANCE_BINS + 1), -20.0)
    scores[0, :, 35] = np.log(1 - probability)
    scores[0, :, DISTANCE_BINS] = np.log(probability)
    coded = read_scores(scores, torch.zeros(1, ANGLE_BINS))
    ends = np.array([tf.RANGES[name].inactive for name in tf.MARKINGS], float)
    answered = tf.decode_values(coded.numpy())[0, :5]
    assert np.isclose(answered, ends, atol=1e-4).tolist() == absent


def test_the_loss_is_least_at_the_target_and_follows_alpha() -> None:
    coded, heading = coded_cases(), torch.tensor([0, 1, 2, 1])
    exact = [part.clamp_min(1e-9).log() for part in bin_targets(coded)]
    sure = torch.nn.functional.one_hot(heading, 3) * 20.0

    def loss(distance: torch.Tensor, alpha: tuple[float, float, float]) -> Losses:
        weighting = TaskWeighting("fixed", alpha, torch.device("cpu"))
        return bins_loss(Scores(distance, exact[1], sure), coded, heading, weighting.total)

    best, off = (loss(d, (1.0, 0.0, 0.0)) for d in (exact[0], exact[0].roll(3, 2)))
    assert float(best.total) < float(off.total) - 1.0
    assert float(best.distance) < 1e-5 < float(off.distance)
    assert float(best.total) == pytest.approx(float(best.terms[0]))
    only_class = loss(exact[0].roll(3, 2), (0.0, 0.0, 0.5))
    assert float(only_class.total) == pytest.approx(0.0, abs=1e-6)


def made() -> Network:
    """A network whose heads have scores as large as trained ones."""
    network = Network(architecture=GRID, batch_norm=True)
    initialise(network, 1)
    network.train()
    with torch.no_grad():
        network(
            torch.from_numpy(images(4))
        )  # moves the running statistics from their initial values
        for name in ("distance", "angle"):
            network.get_parameter(f"heads.{name}.weight").mul_(30)
    return network.eval()


def images(count: int, seed: int = 0) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.random.default_rng(seed).integers(0, 256, (count, 210, 280, 3), dtype=np.uint8)


def test_the_grid_keeps_its_places_and_reads_no_sky() -> None:
    assert grid_size(GRID) == (32, 9, 18)
    network, frames = made(), images(2, 3)
    assert tuple(network.forward_grid(torch.from_numpy(frames)).shape) == (2, 32, 9, 18)
    before = predict_images(network, frames)
    frames[:, :66] = 0
    assert before.tolist() == predict_images(network, frames).tolist()
    frames[:, 66] = 0
    assert before.tolist() != predict_images(network, frames).tolist()


def test_what_is_for_training_only_is_gone_when_folded() -> None:
    network = made()
    folded = fold(network)
    assert network.auxiliary is not None
    assert folded.auxiliary is None
    assert sum(p.numel() for p in folded.parameters()) == 3_630_634
    frames = images(3, 4)
    np.testing.assert_allclose(
        predict_images(network, frames), predict_images(folded, frames), atol=2e-5
    )


def test_an_onnx_model_reads_bins_as_torch_does(tmp_path: Path) -> None:
    network = fold(made())
    write_onnx(network, tmp_path, bf16=False)
    frames = images(4, 6)
    found = check_export(network, tmp_path / ONNX_FILE, "f32", frames)
    assert found["largest"] < TOLERANCE
    options = {"INFERENCE_PRECISION_HINT": "f32"}  # on some processors the default is bf16
    model = openvino_core().compile_model(str(tmp_path / ONNX_FILE), "CPU", options)
    assert [result.any_name for result in model.outputs] == ["outputs", "absent"]
    assert [part.shape for part in model(frames).values()] == [(4, OUTPUTS), (4, len(tf.MARKINGS))]
    (batch, *sizes) = model.input("images").partial_shape
    assert (batch.is_dynamic, sizes) == (True, [210, 280, 3])
    absent = [model(frame[None])["absent"][0] for frame in frames]
    for count in (0, 3, 4):  # each as alone
        together = model(frames[:count])["absent"]
        np.testing.assert_allclose(together, absent[:count] or np.empty((0, 5)), atol=TOLERANCE)
    np.testing.assert_allclose(absent, absent_of(network, frames), atol=TOLERANCE)


def test_the_graph_gives_the_probabilities_of_absence() -> None:
    network, frames = fold(made()), images(6, 7)
    with torch.no_grad():  # large scores of "absent", different for each image
        rows = network.get_parameter("heads.distance.weight")
        rows.view(len(tf.MARKINGS), DISTANCE_BINS + 1, -1)[:, -1] *= 5.0
    found = run_graph(build_graph(network), "f32", frames)
    assert found.shape == (6, OUTPUTS + len(tf.MARKINGS))
    parts = split_outputs(found)
    assert parts.absent is not None
    np.testing.assert_allclose(parts.absent, absent_of(network, frames), atol=TOLERANCE)
    np.testing.assert_array_equal(parts.absent[:, 0], parts.absent[:, 1])  # ml and mr
    assert np.ptp(parts.absent, axis=0).max() > 0.1
    assert parts.absent.max() > 0.5
    for row in found:
        prediction = decode_outputs(row)
        assert prediction.absent is not None
        for name, limit in zip(tf.MARKINGS, ABSENT_ABOVE, strict=True):
            assert prediction.distances_m[name] is None or prediction.absent[name] <= limit


def test_the_graph_reads_bins_as_torch_does() -> None:
    network, frames = fold(made()), images(12, 5)
    options = {"INFERENCE_PRECISION_HINT": "f32"}
    graph = openvino_core().compile_model(build_feature_graph(network), "CPU", options)
    with torch.inference_mode():
        found_by_torch = FitInputs(network)(torch.from_numpy(frames))
    expected, inputs, _ = (each.numpy() for each in found_by_torch)
    found = [graph(frame[None]) for frame in frames]
    assert np.ptp(expected[:, :6], axis=0).max() > 0.05
    np.testing.assert_allclose([row[0][0] for row in found], expected, atol=TOLERANCE)
    assert inputs.shape == (12, GRID.uncertainty_inputs)
    np.testing.assert_allclose([row[1][0] for row in found], inputs, rtol=1e-3, atol=1e-4)
