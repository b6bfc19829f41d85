"""Sources of perception: parsed and refused predictions, images of the model's camera."""

import hashlib
import json
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from controllers.perception.perceived import Perceive, Perceived
from controllers.perception.sources import (
    CameraPerception,
    LocalModel,
    ServiceModel,
    model_identity,
    open_perception,
    parse_camera,
    parse_prediction,
)
from mtlnet.inference.engine import INT8, load_engine
from mtlnet.inference.golden_image import golden_image
from mtlnet.inference.model_card import (
    GRAPH,
    GRAPH_WEIGHTS,
    UNCERTAINTY_WEIGHTS,
    WEIGHTS,
    read_card,
    resolve_run,
)
from mtlnet.inference.prediction import decode_outputs
from mtlnet.inference.shipped_models import SHIPPED
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World
from tests.serve.conftest import CARD, constant_engine, serving
from trackfeatures import VERSION, DefinitionsMismatch, RoadClass, UserError
from trackfeatures.camera import CameraParameters

ANSWER: dict[str, Any] = {
    "distances_m": {"ml": -1.5, "mr": 2.5, "l": None, "m": None, "r": None},
    "to_lane_centre_m": 0.5,
    "angle_rad": -0.03,
    "heading": {"left": 0.2, "straight": 0.1, "right": 0.7},
}
CAMERA = {
    "width": 84, "height": 63, "x": 0.75, "y": 0.0, "z": 0.95, "pitch_deg": 0.0, "fov_y_deg": 67.5,
}  # fmt: skip


def test_the_model_averages_the_views_that_are_asked_for() -> None:
    image = golden_image(280, 210)
    image[:, :100] //= 2  # not symmetric
    for views in (1, 2):
        expected = decode_outputs(load_engine(resolve_run("default"), views=views)(image))
        assert LocalModel("default", views).predict(image) == expected.as_json()
    with World(Road(find_track("oval"))) as world:
        world.reset(seed=0)
        scene: dict[str, Any] = {"lane_centre": 0.0, "light": "clear", "seed": 0}
        answers = []
        for views in (1, 2):
            with open_perception("model", world, model="default", views=views, **scene) as source:
                answers.append(source(world))
    assert answers[0].angle != answers[1].angle
    assert answers[1].angle == pytest.approx(answers[0].angle, abs=0.02)


class FakeClient:
    """Replaces `serve.client.Client`."""

    card: dict[str, Any] = {"definitions_version": VERSION, "camera": CAMERA}  # noqa: RUF012  # replaced whole
    bodies: list[bytes] = []  # noqa: RUF012  # emptied by the test
    url = ""
    closed = False

    def __init__(self, url: str) -> None:
        FakeClient.url, FakeClient.closed = url, False

    def model(self) -> dict[str, Any]:
        return self.card

    def features(self, image: bytes) -> dict[str, Any]:
        self.bodies.append(image)
        return ANSWER

    def close(self) -> None:
        FakeClient.closed = True


def opened(name: str, world: World) -> AbstractContextManager[Perceive]:
    return open_perception(name, world, model="latest", lane_centre=0.0, light="clear", seed=0)


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> type[FakeClient]:
    monkeypatch.setattr("serve.client.Client", FakeClient)
    FakeClient.bodies.clear()
    return FakeClient


def test_a_prediction_is_parsed() -> None:
    assert parse_prediction(ANSWER) == Perceived(0.5, -0.03, RoadClass.RIGHT)
    assert parse_prediction({**ANSWER, "to_lane_centre_m": None}).to_lane_centre is None


def test_standard_deviations_are_parsed() -> None:
    std = {"ml": 0.1, "to_lane_centre": 0.04, "angle": 0.01}
    uncertain = parse_prediction({**ANSWER, "std": std, "out_of_distribution": True})
    assert (uncertain.offset_std_m, uncertain.angle_std_rad) == (0.04, 0.01)
    assert uncertain.out_of_distribution is True
    plain = parse_prediction({**ANSWER, "std": None, "out_of_distribution": None})
    assert plain == Perceived(0.5, -0.03, RoadClass.RIGHT)
    blind = {**ANSWER, "to_lane_centre_m": None, "std": {**std, "to_lane_centre": None}}
    assert parse_prediction(blind).offset_std_m is None


@pytest.mark.parametrize(
    "answer",
    [
        {},
        {**ANSWER, "std": [0.1]},
        {**ANSWER, "std": {"to_lane_centre": "wide", "angle": 0.1}},
        {**ANSWER, "std": {"to_lane_centre": 0.1, "angle": float("nan")}},
        {**ANSWER, "heading": {"left": 1.0}},
        {**ANSWER, "angle_rad": "north"},
        {**ANSWER, "heading": None},
        {**ANSWER, "to_lane_centre_m": "x"},
        {**ANSWER, "to_lane_centre_m": float("nan")},
        {**ANSWER, "angle_rad": float("nan")},
        {**ANSWER, "angle_rad": float("-inf")},
        {**ANSWER, "heading": {**ANSWER["heading"], "left": float("nan")}},
    ],
)
def test_a_malformed_prediction_is_refused(answer: dict[str, Any]) -> None:
    with pytest.raises(UserError, match="perception service"):
        parse_prediction(answer)


def test_an_image_is_sent_to_the_service_as_jpeg(client: type[FakeClient]) -> None:
    service = ServiceModel("http://127.0.0.1:8000/features")
    assert client.url == "http://127.0.0.1:8000"
    image: NDArray[np.uint8] = np.full((63, 84, 3), 90, np.uint8)
    assert service.predict(image) == ANSWER
    assert client.bodies[0][:2] == b"\xff\xd8"
    assert service.camera == CameraParameters(width=84, height=63)


def test_the_identity_of_a_service_contains_its_views(
    client: type[FakeClient], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = set()
    for views in (1, 2, 2):
        monkeypatch.setattr(client, "card", {**client.card, "views": views})
        found.add(ServiceModel("http://127.0.0.1:8000").identity)
    assert len(found) == 2


def test_the_identity_of_a_service_contains_the_hashes_of_its_int8_graph(
    client: type[FakeClient], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []
    for precision in ("int8", "f32"):
        engine = load_engine(SHIPPED, precision=precision)
        with serving(engine) as service:
            monkeypatch.setattr(client, "card", service.ask("GET", "/model").content)
        found.append(json.loads(ServiceModel("http://127.0.0.1:8000").identity)["int8_files"])
    graph = SHIPPED / INT8 / GRAPH_WEIGHTS
    assert found[0][GRAPH_WEIGHTS] == hashlib.sha256(graph.read_bytes()).hexdigest()
    assert found[1] == {}


def test_the_identity_of_a_service_contains_the_hashes_of_the_models_files(
    client: type[FakeClient], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = set()
    for files in ({"a": "1"}, {"a": "2"}, {"a": "1", UNCERTAINTY_WEIGHTS: "3"}):
        engine = constant_engine()
        engine.card = replace(CARD, files={WEIGHTS: "ab" * 32, **files})
        with serving(engine) as service:
            monkeypatch.setattr(client, "card", service.ask("GET", "/model").content)
        found.add(ServiceModel("http://127.0.0.1:8000").identity)
    assert len(found) == 3
    assert all(None not in json.loads(identity).values() for identity in found)


def test_the_identity_of_a_model_contains_its_files_and_its_precision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mtlnet.inference.engine.best_precision", lambda: "f32")
    monkeypatch.setattr("mtlnet.inference.engine.has_int8", lambda: True)
    card = read_card(resolve_run("default"))
    card.write(tmp_path)
    found = [model_identity(str(tmp_path))]
    (tmp_path / INT8).mkdir(parents=True)
    for graph in ("one", "other"):
        about = {"model_hash": card.model_hash, "files": {GRAPH: graph}, "gate": {"passed": True}}
        (tmp_path / INT8 / "export.json").write_text(json.dumps(about))
        found.append(model_identity(str(tmp_path)))
    monkeypatch.setattr("mtlnet.inference.engine.has_int8", lambda: False)
    about["gate"] = {"passed": True, "native_int8": True}
    (tmp_path / INT8 / "export.json").write_text(json.dumps(about))
    assert model_identity(str(tmp_path)) == found[0]
    replace(card, files={**card.files, UNCERTAINTY_WEIGHTS: "3"}).write(tmp_path)
    found.append(model_identity(str(tmp_path)))
    assert len(set(found)) == 4


def test_a_service_with_other_definitions_or_no_camera_is_refused(
    client: type[FakeClient], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "card", {"definitions_version": "0", "camera": CAMERA})
    with pytest.raises(DefinitionsMismatch):
        ServiceModel("http://127.0.0.1:8000")
    monkeypatch.setattr(client, "card", {"definitions_version": VERSION})
    with pytest.raises(UserError, match="camera"):
        ServiceModel("http://127.0.0.1:8000")


def test_images_are_rendered_with_the_models_camera(client: type[FakeClient]) -> None:
    """An image of the model's size is rendered, encoded and sent; the answer is parsed."""
    with World(Road(find_track("oval"))) as world:
        world.reset(seed=0)
        with opened("http://127.0.0.1:8000", world) as perceive:
            assert isinstance(perceive, CameraPerception)
            assert perceive(world) == Perceived(0.5, -0.03, RoadClass.RIGHT)
    assert client.closed
    import simplejpeg

    picture = simplejpeg.decode_jpeg(client.bodies[0])
    assert picture.shape == (63, 84, 3)
    assert picture.std() > 10  # not a uniform picture


LENS = CameraParameters(
    width=84,
    height=63,
    roll_deg=2.0,
    yaw_deg=-5.0,
    matrix=(60.0, 61.0, 40.0, 30.0),
    distortion="fisheye",
    coefficients=(0.1, 0.0, -0.01, 0.0),
    height_std=0.1,
)


def test_the_camera_of_a_service_has_all_fields_of_its_model_card() -> None:
    assert parse_camera(json.loads(json.dumps(LENS.as_dict()))) == LENS


@pytest.mark.parametrize(
    "camera",
    [
        None,
        {},
        {name: value for name, value in CAMERA.items() if name != "pitch_deg"},
        {**CAMERA, "x": "far"},
        {**CAMERA, "x": float("nan")},
        {**CAMERA, "width": float("inf")},
        {**CAMERA, "fov_y_deg": 180.0},
        {**CAMERA, "roll_deg": "left"},
        {**CAMERA, "distortion": "fisheye"},
        {**CAMERA, "shutter": "rolling"},
    ],
)
def test_a_malformed_camera_is_refused(camera: Any) -> None:
    with pytest.raises(UserError, match="model card gives no usable camera"):
        parse_camera(camera)


@pytest.mark.parametrize("word", ["modle", "", "Truth"])
def test_an_unknown_perception_is_refused(word: str) -> None:
    expected = pytest.raises(UserError, match="give truth, model, or the address")
    with World(Road(find_track("oval"))) as world, expected, opened(word, world):
        pass
