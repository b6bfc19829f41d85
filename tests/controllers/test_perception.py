"""Perception: reading answers, refusing what is none, and seeing through a model's camera."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from controllers.perception import CameraPerception, Perceived, Service, open_eyes, read_answer
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World
from trackfeatures import VERSION, DefinitionsMismatch, Heading, UserError

ANSWER: dict[str, Any] = {
    "distances_m": {"ml": -1.5, "mr": 2.5, "l": None, "m": None, "r": None},
    "to_lane_centre_m": 0.5,
    "angle_rad": -0.03,
    "heading": {"left": 0.2, "straight": 0.1, "right": 0.7},
}
CAMERA = {
    "width": 84, "height": 63, "x": 0.75, "y": 0.0, "z": 0.95, "pitch_deg": 0.0, "fov_y_deg": 67.5,
}  # fmt: skip


class FakeClient:
    """Stands for `serve.client.Client`."""

    card: dict[str, Any] = {"definitions_version": VERSION, "camera": CAMERA}  # noqa: RUF012  # replaced whole
    bodies: list[bytes] = []  # noqa: RUF012  # emptied by the test
    url = ""

    def __init__(self, url: str) -> None:
        FakeClient.url = url

    def model(self) -> dict[str, Any]:
        return self.card

    def features(self, image: bytes) -> dict[str, Any]:
        self.bodies.append(image)
        return ANSWER

    def close(self) -> None:
        pass


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> type[FakeClient]:
    monkeypatch.setattr("serve.client.Client", FakeClient)
    FakeClient.bodies.clear()
    return FakeClient


def test_an_answer_is_read() -> None:
    assert read_answer(ANSWER) == Perceived(0.5, -0.03, Heading.RIGHT)
    assert read_answer({**ANSWER, "to_lane_centre_m": None}).to_lane_centre is None


@pytest.mark.parametrize(
    "answer",
    [
        {},
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
def test_what_is_no_answer_is_refused(answer: dict[str, Any]) -> None:
    with pytest.raises(UserError, match="perception service"):
        read_answer(answer)


def test_a_service_gets_a_jpeg(client: type[FakeClient]) -> None:
    service = Service("http://127.0.0.1:8000/features")
    assert client.url == "http://127.0.0.1:8000"
    image: NDArray[np.uint8] = np.full((63, 84, 3), 90, np.uint8)
    assert service.look(image) == ANSWER
    assert client.bodies[0][:2] == b"\xff\xd8"
    assert service.camera == CAMERA


def test_a_service_of_other_definitions_is_refused(
    client: type[FakeClient], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "card", {"definitions_version": "0", "camera": CAMERA})
    with pytest.raises(DefinitionsMismatch):
        Service("http://127.0.0.1:8000")
    monkeypatch.setattr(client, "card", {"definitions_version": VERSION})
    with pytest.raises(UserError, match="camera"):
        Service("http://127.0.0.1:8000")


def test_the_camera_is_that_of_the_model(client: type[FakeClient]) -> None:
    """A rendered picture of the model's size, encoded for the service, comes back as features."""
    with World(Road(find_track("oval"))) as world:
        world.reset(seed=0)
        eyes = open_eyes(
            "http://127.0.0.1:8000", world, model="latest", lane_centre=0.0, light="clear", seed=0
        )
        with eyes:
            assert isinstance(eyes.perceive, CameraPerception)
            assert eyes.perceive(world) == Perceived(0.5, -0.03, Heading.RIGHT)
    import simplejpeg

    picture = simplejpeg.decode_jpeg(client.bodies[0])
    assert picture.shape == (63, 84, 3)
    assert picture.std() > 10  # a scene, not a blank


@pytest.mark.parametrize("word", ["modle", "", "Truth"])
def test_an_unknown_perception_is_named(word: str) -> None:
    expected = pytest.raises(UserError, match="give truth, model, or the address")
    with World(Road(find_track("oval"))) as world, expected:
        open_eyes(word, world, model="latest", lane_centre=0.0, light="clear", seed=0)
