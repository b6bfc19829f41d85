"""Fixtures of the mtlnet tests: a small dataset of drawn roads and a published model."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording import Dataset
from datagen.recording.frame import DriverCommand, EgoState, Frame, RoadPlace
from datagen.recording.mcap.writer import RoundWriter
from datagen.recording.round_metadata import RoundHeader
from datagen.recording.splits import Split, split_path, write_split
from mtlnet.architecture import ARCHITECTURES, GRID, HEIGHT, MTL, WIDTH, Conv
from mtlnet.data.description import describe_data
from mtlnet.export.publish import Provenance, publish
from mtlnet.inference.model_card import read_card, resolve_run
from mtlnet.inference.prediction import decode_outputs
from mtlnet.model.network import Network, initialise
from mtlnet.training.config import TrainConfig
from mtlnet.uncertainty_fit import ood
from mtlnet.uncertainty_fit.head import fit_uncertainty_head
from tests.mtlnet.predict.brightness_engine import BrightnessEngine
from trackfeatures.camera import CameraParameters

FRAMES = 24
TRAIN, TEST = ("r000", "r001", "r002"), ("r003",)


def draw_road(to_middle: float, angle: float) -> NDArray[np.uint8]:
    """A flat one-lane road, 4 m wide, seen from 1.2 m above; uint8 RGB (HEIGHT, WIDTH, 3)."""
    focal = HEIGHT / 2 / np.tan(np.radians(67.5 / 2))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    below = np.maximum((rows + 0.5 - HEIGHT / 2) / focal, 1e-3)
    ahead = 1.2 / below
    left = -(columns + 0.5 - WIDTH / 2) / focal * ahead
    across = to_middle - ahead * np.sin(angle) + left * np.cos(angle)
    image = np.full((HEIGHT, WIDTH, 3), (150, 190, 230), np.uint8)
    ground = rows > HEIGHT / 2
    image[ground] = (60, 110, 60)
    image[ground & (np.abs(across) < 3)] = (100, 100, 104)
    image[ground & (np.abs(np.abs(across) - 2) < 0.1)] = (230, 230, 230)
    return image


def drawn_frame(rng: np.random.Generator) -> Frame:
    to_middle, angle = rng.uniform(-1.5, 1.5), rng.normal(0.0, 0.05)
    curvature = float(rng.choice([-0.02, 0.0, 0.02]))
    return Frame(
        image=draw_road(to_middle, angle),
        features=tf.measure(to_middle, angle, curvature, curvature, 1, 4.0),
        place=RoadPlace(1, 0, curvature, to_middle, 7.0),
        ego=EgoState(1.0, 2.0, 0.3, angle, 0.0, 0.0, 15.0, 0.0, 0.0),
        command=DriverCommand(0.0, 0.2, 0.0, 1),
    )


def write_round(folder: Path, name: str, number: int, **changes: Any) -> None:
    """Write a round of `FRAMES` drawn frames to a dataset folder; `changes`: fields of its
    header."""
    rng = np.random.default_rng(number)
    values: dict[str, Any] = {
        "id": name,
        "seed": number,
        "track": "alpha" if number % 2 else "beta",
        "track_hash": "0" * 64,
        "lanes": 1,
        "lane_width_m": 4.0,
        "traffic": 0,
        "trajectory": "weave",
        "lights": ("clear",),
        "speed_kmh": 60.0,
        **changes,
    }
    with RoundWriter(folder / "rounds" / f"{name}.mcap", RoundHeader(**values), {}) as writer:
        for _ in range(FRAMES):
            writer.add(drawn_frame(rng))
        writer.finish()


HIGH_CAMERA = CameraParameters(z=1.55)
"""A camera 1.8 m above the road, 1.5 times as high as the model's."""
HIGH_ROUNDS: dict[str, Any] = {
    "camera": HIGH_CAMERA,
    "nominal_camera": CameraParameters(),
    "varied": {"carriageway": {"markings": [{"lines": [{"offset_m": 0.0}]}, {"lines": []}]}},
}
"""Header fields of such rounds of varied roads: one lane, without paint on its right."""


def write_dataset(
    folder: Path, first_seed: int = 0, train_rounds: int = len(TRAIN), **changes: Any
) -> Path:
    """Write train rounds and a test round to an existing, empty folder; returns it. `changes`:
    header fields."""
    (folder / "rounds").mkdir()
    *train, test = (f"r{number:03}" for number in range(train_rounds + 1))
    for number, name in enumerate((*train, test)):
        write_round(folder, name, first_seed + number, **changes)
    (folder / "splits").mkdir()
    write_split(split_path(folder), Split(tuple(train), (test,)))
    return folder


def require_close(
    outputs: NDArray[np.float32], expected: NDArray[np.float32], *, metres: float, radians: float
) -> None:
    """Assert that the outputs of two models decode to nearly the same features. `metres`: tolerance
    of distances and offset; `radians`: of the angle; that of the class probabilities is 0.02."""
    found, wanted = decode_outputs(outputs), decode_outputs(expected)
    assert found.distances_m == pytest.approx(wanted.distances_m, abs=metres)
    assert found.to_lane_centre_m == pytest.approx(wanted.to_lane_centre_m, abs=metres)
    assert found.angle_rad == pytest.approx(wanted.angle_rad, abs=radians)
    assert found.heading == pytest.approx(wanted.heading, abs=0.02)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three train rounds and a test round of `FRAMES` frames each."""
    return write_dataset(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="session")
def published(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with an untrained, published network and a fitted uncertainty head."""
    network = Network()
    initialise(network, 5)
    run = tmp_path_factory.mktemp("runs") / "untrained"
    data = Dataset.open(dataset)
    frames = data.select("train")
    uncertainty = fit_uncertainty_head(network, frames, None, 0)
    images = np.stack([draw_road(d, 0.0) for d in (-1.0, 0.5)])
    provenance = Provenance(data=describe_data(data, frames))
    publish(network, run, images, provenance, uncertainty)
    return run


@pytest.fixture
def engine() -> BrightnessEngine:
    """The engine of the tests of `mtlnet predict`."""
    return BrightnessEngine(read_card(resolve_run("default")))


@pytest.fixture
def small_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the default network and the paper's by networks with few filters and units."""
    for full in (MTL, GRID):
        few = tuple(
            replace(spec, filters=8) if isinstance(spec, Conv) else spec for spec in full.features
        )
        small = replace(full, features=few, shared=(32, 16, 16))
        monkeypatch.setitem(ARCHITECTURES, full.name, small)


@pytest.fixture
def short_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fit the pitch of a trained model in 40 steps on 8 frames; otherwise it takes 2 s per
    training."""
    monkeypatch.setattr(ood, "FIT", replace(ood.FIT, steps=40))
    monkeypatch.setattr(ood, "PITCH_FRAMES", 8)


@pytest.fixture
def no_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    """Train and publish as on a machine without OpenVINO: converting a network takes 3 s per
    training. For tests that do not use the graph."""
    monkeypatch.setitem(sys.modules, "openvino", None)


def training_config(dataset: Path, out: Path, **changes: Any) -> TrainConfig:
    """Configuration of a run of four steps on a dataset of `write_dataset`."""
    values = {"iterations": 4, "batch": 4, "seed": 7, "device": "cpu", "threads": 1, **changes}
    return TrainConfig(dataset, out, **values)
