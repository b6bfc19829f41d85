"""The uncertainty head: standard deviations that match errors, and the OOD score."""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from datagen.recording import Dataset
from mtlnet.evaluation.metrics import calibration, coverage
from mtlnet.inference.engine import Precision, load_engine
from mtlnet.inference.model_card import WEIGHTS, resolve_run
from mtlnet.inference.prediction import FEATURES, OUTPUTS, decode_outputs, split_outputs
from mtlnet.inference.torch_engine import read_uncertainty_head
from mtlnet.model.network import load_network
from mtlnet.model.textures import CELL_VALUES, LIGHT_VALUES, light_features, texture_features
from mtlnet.model.uncertainty_head import LIGHT_LIMIT, UncertaintyHead, standardise
from mtlnet.uncertainty_fit.frame_outputs import FrameOutputs
from mtlnet.uncertainty_fit.head import (
    fit_std_layers,
    fit_uncertainty_head,
    standardisation,
)
from mtlnet.uncertainty_fit.ood import draw_view, fit_texture_distance, view_homography
from tests.mtlnet.conftest import write_dataset
from tests.mtlnet.ood_images import images_without_road, seen_by
from trackfeatures.camera import CameraParameters

OOD_IMAGES = 1000
ROOT = Path(__file__).parents[3]


def textures_of(images: Iterable[np.ndarray]) -> np.ndarray:
    """Texture features (N, C + M) of images."""
    return np.stack([texture_features(torch.from_numpy(one[None]))[0].numpy() for one in images])


def predict(head: UncertaintyHead, x: np.ndarray, textures: np.ndarray) -> np.ndarray:
    """Standard deviations and OOD scores (N, D + 1)."""
    found: np.ndarray = head(torch.from_numpy(x), torch.from_numpy(textures)).numpy()
    return found


def zero_pitch_layers() -> dict[str, np.ndarray]:
    """Pitch layers whose output is 0."""
    shapes: dict[str, tuple[int, ...]] = {"_centre": (0,), "_scale": (0,)}
    shapes |= {".first.weight": (1, 0), ".first.bias": (1,)}
    shapes |= {".second.weight": (1, 1), ".second.bias": (1,)}
    return {f"pitch{name}": np.zeros(shape, np.float32) for name, shape in shapes.items()}


def fitted(
    seed: int, count: int, of: int
) -> tuple[UncertaintyHead, np.ndarray, np.ndarray, np.ndarray]:
    """A head fitted to errors of known deviations; inputs, deviations and errors of other
    frames."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count + of, 6)).astype(np.float32)
    true = np.exp(0.5 * x[:, :1] - 2 + 0.2 * np.arange(7))
    error = (rng.normal(size=true.shape) * true).astype(np.float32)
    error[rng.random(error.shape) < 0.2] = np.nan
    layers = fit_std_layers(x[:count], error[:count], 0, None)
    zero = np.zeros(1, np.float32)
    state = {"centre": np.zeros(6, np.float32), "scale": np.ones(6, np.float32), **layers}
    state |= {"texture_mean": zero, "texture_directions": zero[None], **zero_pitch_layers()}
    head = UncertaintyHead({name: torch.from_numpy(values) for name, values in state.items()})
    return head, x[count:], true[count:], error[count:]


def test_known_standard_deviations_are_recovered() -> None:
    head, x, true, error = fitted(1, 3000, 3000)
    std = predict(head, x, np.zeros((len(x), 1), np.float32))[:, :-1]
    assert np.median(np.abs(np.log(std / true))) < 0.12
    for within in coverage(std, error).values():
        assert within[0] == pytest.approx(0.683, abs=0.04)
        assert within[1] == pytest.approx(0.954, abs=0.025)
    for bins in calibration(std, error.astype(np.float64)).values():
        assert len(bins) == 10
        assert [b["said"] for b in bins] == sorted(b["said"] for b in bins)
        for part in bins:
            assert part["found"] == pytest.approx(part["said"], rel=0.3)


def test_both_shares_are_near_those_of_a_normal_distribution_despite_outliers() -> None:
    rng = np.random.default_rng(5)
    x = rng.normal(size=(6000, 6)).astype(np.float32)
    error = (rng.standard_t(3, (6000, 7)) * np.exp(0.5 * x[:, :1] - 2)).astype(np.float32)
    layers = fit_std_layers(x[:3000], error[:3000], 0, None)
    hidden = np.maximum(x[3000:] @ layers["std.first.weight"].T + layers["std.first.bias"], 0)
    std = np.exp(hidden @ layers["std.second.weight"].T + layers["std.second.bias"])
    for one, two in coverage(std, error[3000:]).values():
        assert one == pytest.approx(0.683, abs=0.05)
        assert two == pytest.approx(0.954, abs=0.05)


def test_a_feature_that_is_never_present_has_a_finite_deviation() -> None:
    rng = np.random.default_rng(2)
    error = rng.normal(size=(200, 7)).astype(np.float32)
    error[:, 2] = np.nan
    layers = fit_std_layers(rng.normal(size=(200, 4)).astype(np.float32), error, 0, None)
    assert all(np.isfinite(value).all() for value in layers.values())


def test_a_feature_that_is_silent_in_training_does_not_make_the_fit_diverge() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(0.0, 20.0, (900, 8)).astype(np.float32)
    x[:, 0] = 0.0
    x[::300, 0] = 0.004  # a ReLU that is on in three frames
    unseen = x[:400].copy()
    unseen[::2, 0] = 60.0
    error = rng.normal(0.0, 0.1, (900, 7)).astype(np.float32)
    centre, scale = standardisation(x, 8)
    held_out = FrameOutputs((unseen - centre) * scale, error[:400], np.zeros((400, 1), np.float32))
    layers = fit_std_layers((x - centre) * scale, error, 0, held_out)
    assert all(np.isfinite(values).all() for values in layers.values())


def test_texture_distance_has_the_given_false_alarm_rate() -> None:
    rng = np.random.default_rng(3)
    mixing = rng.normal(size=(20, 20))
    known, held_out, new = (
        (rng.normal(size=(n, 20)) @ mixing).astype(np.float32) for n in (3000, 3000, 3000)
    )
    mean, directions = fit_texture_distance(known, held_out, 0.01)
    squared = (((new - mean) @ directions.T) ** 2).sum(1)
    assert float((squared > 1).mean()) == pytest.approx(0.01, abs=0.007)
    far = new + 8 * mixing[0]
    assert float(((((far - mean) @ directions.T) ** 2).sum(1) > 1).mean()) > 0.99


def test_texture_features_of_a_step_edge() -> None:
    image = np.zeros((210, 280, 3), np.uint8)
    image[:, 70:] = 255  # where the third of eight cell columns begins
    features = textures_of([image])[0]
    cells = features[:CELL_VALUES].reshape(5, 14, 8)
    centre = features[CELL_VALUES:].reshape(5, 24, 4)
    assert cells[:3, :, :2] == pytest.approx(-1)
    assert cells[:3, :, 2:] == pytest.approx(1)
    assert cells[3, :, 1] == pytest.approx((2 / 35) ** 0.5, rel=1e-3)  # one step of 2 in 35 pixels
    assert np.delete(cells[3], 1, 1) == pytest.approx(1e-3)
    assert cells[4] == pytest.approx(1e-3)
    assert centre[:3] == pytest.approx(1)
    image[:50] = 0  # up to the second band (5 rows) of the centre, which begins at row 45
    centre = textures_of([image])[0, CELL_VALUES:].reshape(5, 24, 4)
    assert centre[0, 0] == pytest.approx(-1)
    assert centre[0, 1:] == pytest.approx(1)
    assert centre[4, 0] == pytest.approx((2 / 5) ** 0.5, rel=1e-3)
    assert centre[4, 1:] == pytest.approx(1e-3)


def test_the_light_of_an_image_is_told_of_each_half() -> None:
    image = np.full((210, 280, 3), 255, np.uint8)
    image[105:] = (0, 51, 102)
    light = light_features(torch.from_numpy(textures_of([image]))).numpy().reshape(5, 2)
    assert light[:3, 0] == pytest.approx(1)
    assert light[:3, 1] == pytest.approx([-1, -0.6, -0.2], abs=1e-5)
    assert light[3] == pytest.approx(1e-3)  # no edge across
    step = (1.6 / 15) ** 0.5  # in one of seven rows of cells, of 15 pixels each
    assert light[4] == pytest.approx([(step + 6e-3) / 7, 1e-3], rel=1e-3)


def test_standard_deviations_follow_the_light_within_limits(
    dataset: Path, published: Path, tmp_path: Path
) -> None:
    few = read_uncertainty_head(published)  # no rounds were held out
    network = load_network(published / WEIGHTS)
    features = network.architecture.uncertainty_inputs
    assert len(few.centre) == features
    (tmp_path / "held").mkdir()
    frames, held_out = (
        Dataset.open(folder).select("train")
        for folder in (dataset, write_dataset(tmp_path / "held", 50))
    )
    head = fit_uncertainty_head(network, frames, held_out, 0).head
    assert len(head.centre) == features + LIGHT_VALUES
    image = frames.image(0)
    dimmed = [(image * factor).astype(np.uint8) for factor in (1.0, 0.9, 0.1)]
    textures = textures_of(dimmed)
    x = np.tile(head.centre[:features].numpy(), (len(dimmed), 1))
    day, dusk, night = np.log(predict(head, x, textures)[:, :-1])
    assert np.abs(day - dusk).max() > 1e-3
    assert np.abs(night - dusk).max() > 1e-3
    light = 1e3 * light_features(torch.from_numpy(textures))
    far = standardise(torch.cat([torch.from_numpy(x), light], 1), head.centre, head.scale, features)
    assert far[:, features:].abs().max() == LIGHT_LIMIT
    alike = predict(few, x, textures)[:, :-1]
    np.testing.assert_array_equal(alike, alike[:1].repeat(len(dimmed), 0))


def test_images_without_a_road_are_out_of_distribution(published: Path) -> None:
    head = read_uncertainty_head(published)
    kinds, images = zip(*images_without_road(OOD_IMAGES, 5), strict=True)
    x = np.zeros((OOD_IMAGES, 256), np.float32)
    found = predict(head, x, textures_of(images))[:, -1] > 1
    by_kind = Counter(kind for kind, ood in zip(kinds, found, strict=True) if ood)
    assert found.mean() > 0.98, by_kind


@pytest.mark.parametrize(("precision", "tolerance"), [("f32", 1e-4), ("bf16", 0.02)])
def test_the_graph_computes_the_score_of_the_texture(
    precision: Precision, tolerance: float
) -> None:
    run = resolve_run("default")
    head, engine = read_uncertainty_head(run), load_engine(run, precision=precision)
    images = [
        np.asarray(cv2.imread(str(path), cv2.IMREAD_COLOR_RGB), np.uint8)
        for path in sorted((ROOT / "serve" / "console").glob("sample-*.jpg"))
    ]
    images += [image for _, image in images_without_road(6, 3)]
    assert len(images) > 10
    x = np.zeros((len(images), len(head.centre)), np.float32)
    expected = predict(head, x, textures_of(images))[:, -1]
    outputs = np.stack([engine(image) for image in images])
    assert split_outputs(outputs).ood_score == pytest.approx(expected, rel=tolerance)


def test_roads_are_in_distribution_and_other_cameras_are_not(
    published: Path, dataset: Path
) -> None:
    frames = Dataset.open(dataset).select("test")
    images = frames.read_batch(np.arange(len(frames)))
    engine = load_engine(published, precision="f32")
    ood = [decode_outputs(engine(image)).out_of_distribution for image in images]
    assert sum(map(bool, ood)) <= 2
    views = [
        seen_by(image, CameraParameters(), fov, pitch)
        for image in images[:6]
        for fov, pitch in ((67.5, 15.0), (67.5, -15.0), (100.0, 20.0), (50.0, -15.0))
    ]
    views += [np.ascontiguousarray(image[::-1]) for image in images[:6]]
    assert all(decode_outputs(engine(view)).out_of_distribution for view in views)


@pytest.mark.parametrize(("pitch_deg", "fov_y_deg"), [(6, 67.5), (-6, 67.5), (7, 80), (-7, 58)])
def test_another_pitch_is_detected_with_its_sign(
    published: Path, dataset: Path, pitch_deg: float, fov_y_deg: float
) -> None:
    frames = Dataset.open(dataset).select("test")
    images = frames.read_batch(np.arange(len(frames)))
    views = [seen_by(image, CameraParameters(), fov_y_deg, pitch_deg) for image in images]
    head = read_uncertainty_head(published)
    offset, known = (
        head.pitch_offset(torch.from_numpy(textures_of(seen)[:, CELL_VALUES:]))[:, 0].numpy()
        for seen in (views, images)
    )
    assert (offset**2 > 1).mean() > 0.9
    assert (np.sign(offset) == np.sign(pitch_deg)).mean() > 0.9
    assert (np.abs(known) > 1).sum() <= 1


def test_the_centre_of_a_drawn_view_lies_in_the_frame() -> None:
    camera, rng = CameraParameters(), np.random.default_rng(8)
    shape = (camera.height, camera.width)
    steepest = 0.0
    for _ in range(200):
        pitch, log_zoom = draw_view(camera, rng)
        steepest = max(steepest, abs(pitch))
        full = np.full((*shape, 3), 200, np.uint8)
        seen = cv2.warpPerspective(full, view_homography(camera, pitch, log_zoom), shape[::-1])
        assert (seen[45:166, 70:211] == 200).all()
    assert steepest > np.radians(12)


def test_a_view_matches_that_cameras_image(dataset: Path) -> None:
    camera = CameraParameters()
    image = Dataset.open(dataset).select("test").image(0)
    expected = seen_by(image, camera, 80.0, 5.0)
    log_zoom = np.log(np.tan(np.radians(40.0)) / np.tan(np.radians(camera.fov_y_deg / 2)))
    homography = view_homography(camera, np.radians(5.0), log_zoom)
    found = cv2.warpPerspective(image, homography, (camera.width, camera.height))
    inside = np.s_[50:160, 75:205]
    # The expected image is shifted by half a pixel.
    assert np.abs(found[inside].astype(int) - expected[inside]).mean() < 6


def test_predictions_have_standard_deviations_and_ood_flag(published: Path) -> None:
    outputs = load_engine(published)(np.zeros((210, 280, 3), np.uint8))
    assert outputs.shape == (OUTPUTS + len(FEATURES) + 1,)
    prediction = decode_outputs(outputs)
    assert prediction.out_of_distribution is True
    assert prediction.std is not None
    assert prediction.std["angle"] == pytest.approx(outputs[OUTPUTS + 6])
