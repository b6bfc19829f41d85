"""Doubt: standard deviations that are as large as the errors, and images that show no road."""

from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest

from datagen.recording import Dataset
from mtlnet.evaluation.metrics import calibration, coverage
from mtlnet.inference.engine import load_engine
from mtlnet.inference.prediction import OUTPUTS, decode_outputs
from mtlnet.inference.uncertainty import CELL_VALUES, FEATURES, UncertaintyHead, read_uncertainty_head, texture
from mtlnet.uncertainty_fit.camera_pitch import aimed, draw_aim
from mtlnet.uncertainty_fit.head import fit_head, novelty
from tests.mtlnet.strange import no_road, seen_by
from trackfeatures.camera import CameraParameters

NO_ROAD = 1000


def no_aim() -> dict[str, np.ndarray]:
    """Layers that tell nothing of any picture."""
    shapes: dict[str, tuple[int, ...]] = {"centre": (0,), "scale": (0,)}
    shapes |= {"hidden_weight": (1, 0), "hidden_bias": (1,), "weight": (1, 1), "bias": (1,)}
    return {f"aim_{name}": np.zeros(shape, np.float32) for name, shape in shapes.items()}


def fitted(
    seed: int, count: int, of: int
) -> tuple[UncertaintyHead, np.ndarray, np.ndarray, np.ndarray]:
    """A head fitted to errors of known deviations; features, deviations, errors of other frames."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count + of, 6)).astype(np.float32)
    true = np.exp(0.5 * x[:, :1] - 2 + 0.2 * np.arange(7))
    error = (rng.normal(size=true.shape) * true).astype(np.float32)
    error[rng.random(error.shape) < 0.2] = np.nan
    head = fit_head(x[:count], error[:count], 0, None)
    nothing = np.zeros(1, np.float32)
    doubt = UncertaintyHead(
        np.zeros(6, np.float32), np.ones(6, np.float32), **head,
        usual=nothing, directions=nothing[None], **no_aim(),
    )  # fmt: skip
    return doubt, x[count:], true[count:], error[count:]


def test_known_deviations_are_recovered() -> None:
    doubt, x, true, error = fitted(1, 3000, 3000)
    said = doubt.assess(x, np.zeros((len(x), 1), np.float32))[:, :-1]
    assert np.median(np.abs(np.log(said / true))) < 0.12
    for within in coverage(said, error).values():
        assert within[0] == pytest.approx(0.683, abs=0.04)
        assert within[1] == pytest.approx(0.954, abs=0.025)
    for bins in calibration(said, error.astype(np.float64)).values():
        assert len(bins) == 10
        assert [b["said"] for b in bins] == sorted(b["said"] for b in bins)
        for part in bins:
            assert part["found"] == pytest.approx(part["said"], rel=0.3)


def test_a_feature_never_active_takes_part_all_the_same() -> None:
    rng = np.random.default_rng(2)
    error = rng.normal(size=(200, 7)).astype(np.float32)
    error[:, 2] = np.nan
    head = fit_head(rng.normal(size=(200, 4)).astype(np.float32), error, 0, None)
    assert all(np.isfinite(value).all() for value in head.values())


def test_novelty_keeps_to_its_rate_of_false_alarms() -> None:
    rng = np.random.default_rng(3)
    mixing = rng.normal(size=(20, 20))
    known, held_out, new = (
        (rng.normal(size=(n, 20)) @ mixing).astype(np.float32) for n in (3000, 3000, 3000)
    )
    usual, directions = novelty(known, held_out)
    sizes = (((new - usual) @ directions.T) ** 2).sum(1)
    assert float((sizes > 1).mean()) == pytest.approx(0.01, abs=0.007)
    far = new + 8 * mixing[0]
    assert float(((((far - usual) @ directions.T) ** 2).sum(1) > 1).mean()) > 0.99


def test_a_texture_by_hand() -> None:
    image = np.zeros((210, 280, 3), np.uint8)
    image[:, 70:] = 255  # the third of eight columns of cells begins there
    whole = texture(image)
    cells, middle = whole[:CELL_VALUES].reshape(5, 14, 8), whole[CELL_VALUES:].reshape(5, 24, 4)
    assert cells[:3, :, :2] == pytest.approx(-1)
    assert cells[:3, :, 2:] == pytest.approx(1)
    assert cells[3, :, 1] == pytest.approx((2 / 35) ** 0.5, rel=1e-3)  # one step of 2 in 35 pixels
    assert np.delete(cells[3], 1, 1) == pytest.approx(1e-3)
    assert cells[4] == pytest.approx(1e-3)
    assert middle[:3] == pytest.approx(1)
    image[:50] = 0  # the second of the bands of 5 rows in the middle begins there, at row 45
    middle = texture(image)[CELL_VALUES:].reshape(5, 24, 4)
    assert middle[0, 0] == pytest.approx(-1)
    assert middle[0, 1:] == pytest.approx(1)
    assert middle[4, 0] == pytest.approx((2 / 5) ** 0.5, rel=1e-3)
    assert middle[4, 1:] == pytest.approx(1e-3)


def test_a_thousand_pictures_of_no_road_are_strange(published: Path) -> None:
    doubt = read_uncertainty_head(published)
    kinds, textures = zip(
        *((kind, texture(image)) for kind, image in no_road(NO_ROAD, 5)), strict=True
    )
    told = doubt.assess(np.zeros((NO_ROAD, 256), np.float32), np.stack(textures))[:, -1] > 1
    by_kind = Counter(kind for kind, strange in zip(kinds, told, strict=True) if strange)
    assert told.mean() > 0.98, by_kind


def test_roads_are_known_and_foreign_cameras_are_not(published: Path, dataset: Path) -> None:
    frames = Dataset.open(dataset).select("test")
    images = frames.read_batch(np.arange(len(frames)))
    engine = load_engine(published, precision="f32")
    strange = [decode_outputs(engine(image)).out_of_distribution for image in images]
    assert sum(map(bool, strange)) <= 2
    views = [
        seen_by(image, CameraParameters(), fov, pitch)
        for image in images[:6]
        for fov, pitch in ((67.5, 15.0), (67.5, -15.0), (100.0, 20.0), (50.0, -15.0))
    ]
    views += [np.ascontiguousarray(image[::-1]) for image in images[:6]]
    assert all(decode_outputs(engine(view)).out_of_distribution for view in views)


@pytest.mark.parametrize(("pitch_deg", "fov_y_deg"), [(6, 67.5), (-6, 67.5), (7, 80), (-7, 58)])
def test_a_camera_that_looks_elsewhere(
    published: Path, dataset: Path, pitch_deg: float, fov_y_deg: float
) -> None:
    frames = Dataset.open(dataset).select("test")
    images = frames.read_batch(np.arange(len(frames)))
    views = np.stack(
        [texture(seen_by(i, CameraParameters(), fov_y_deg, pitch_deg)) for i in images]
    )
    doubt = read_uncertainty_head(published)
    aim = doubt.aim(views[:, CELL_VALUES:])[:, 0]
    assert (aim**2 > 1).mean() > 0.9
    assert (np.sign(aim) == np.sign(pitch_deg)).mean() > 0.9  # and it knows which way
    known = np.stack([texture(image) for image in images])
    assert (np.abs(doubt.aim(known[:, CELL_VALUES:])) > 1).sum() <= 1


def test_no_border_is_ever_seen() -> None:
    camera, rng = CameraParameters(), np.random.default_rng(8)
    shape = (camera.height, camera.width)
    steepest = 0.0
    for _ in range(200):
        pitch, wider = draw_aim(camera, rng)
        steepest = max(steepest, abs(pitch))
        full = np.full((*shape, 3), 200, np.uint8)
        seen = cv2.warpPerspective(full, aimed(camera, pitch, wider), shape[::-1])
        assert (seen[45:166, 70:211] == 200).all()
    assert steepest > np.radians(12)


def test_an_aim_is_seen_as_by_that_camera(dataset: Path) -> None:
    camera = CameraParameters()
    image = Dataset.open(dataset).select("test").image(0)
    expected = seen_by(image, camera, 80.0, 5.0)
    wider = np.log(np.tan(np.radians(40.0)) / np.tan(np.radians(camera.fov_y_deg / 2)))
    moved = aimed(camera, np.radians(5.0), wider)
    found = cv2.warpPerspective(image, moved, (camera.width, camera.height))
    middle = np.s_[50:160, 75:205]
    # The oracle's picture is half a pixel aside.
    assert np.abs(found[middle].astype(int) - expected[middle]).mean() < 6


def test_answers_carry_their_doubt(published: Path) -> None:
    outputs = load_engine(published)(np.zeros((210, 280, 3), np.uint8))
    assert outputs.shape == (OUTPUTS + len(FEATURES) + 1,)
    answer = decode_outputs(outputs)
    assert answer.out_of_distribution is True
    assert answer.std is not None
    assert answer.std["angle"] == pytest.approx(outputs[OUTPUTS + 6])
