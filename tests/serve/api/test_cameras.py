"""Named cameras of the service: every endpoint gives the same answers as `mtlnet predict`."""

import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from mtlnet.inference import rectification
from mtlnet.inference.prediction import decode_outputs
from mtlnet.inference.rectification import Rectification, shown_shares
from runtime.camera_file import write_camera
from serve.cameras import MAX_CAMERAS, read_cameras
from serve.client import Client, ServiceError
from serve.config import Limits
from serve.scheduling.loaded_engine import LoadedEngine
from serve.workers.worker_process import WorkerTask
from tests.serve.api.test_options import WIDE, features, infer, post, stream
from tests.serve.conftest import (
    CARD,
    JPEG,
    PATIENCE_S,
    FakeEngine,
    Gate,
    Served,
    constant_engine,
    outputs,
    serving,
    until,
)
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

ROOF = CameraParameters(
    400, 300, x=1.0, y=0.2, z=1.15, yaw_deg=3.0, roll_deg=1.0,
    matrix=(260.0, 260.0, 205.0, 148.0), distortion="opencv", coefficients=(-0.2, 0.05, 0.0, 0.0),
)  # fmt: skip
MODEL = CARD.camera
EXPECTED = decode_outputs(Rectification(ROOF, MODEL).outputs(outputs()[None])[0])


@pytest.fixture
def service(engine: FakeEngine) -> Iterator[Served]:
    with serving(engine, cameras={"roof": ROOF}) as served:
        yield served


def test_the_answer_is_that_of_the_rectified_image(service: Served, engine: FakeEngine) -> None:
    plain = features(service)
    assert plain.content["distances_m"]["mr"] == pytest.approx(2.0, abs=1e-6)
    for reply in (
        features(service, "?camera=roof"),
        features(service, headers=[("X-Camera", "roof")]),
    ):
        assert reply.status == 200
        assert reply.content["distances_m"] == pytest.approx(EXPECTED.distances_m)
        assert reply.content["to_lane_centre_m"] == pytest.approx(EXPECTED.to_lane_centre_m)
        assert reply.content["crop_px"] is None
    # The marking is 1.4 / 1.2 (2 m - 0.75 m sin 0.1) from the camera, and the camera is
    # 0.2 m cos 0.1 - 1 m sin 0.1 left of the car's middle.
    assert EXPECTED.distances_m["mr"] == pytest.approx(2.1468, abs=1e-3)
    first, second, third = engine.images
    assert (first != second).any()
    np.testing.assert_array_equal(second, third)


def test_every_endpoint_takes_it(service: Served) -> None:
    wanted = EXPECTED.distances_m["ml"]
    for reply in (infer(service, "?camera=roof"), infer(service, camera="roof")):
        found = {each["name"]: each["data"] for each in reply.content["outputs"]}
        assert found["distances_m"][0] == pytest.approx(wanted, abs=1e-5)
    assert stream(service, "?camera=roof")["distances_m"]["ml"] == pytest.approx(wanted)
    answer = stream(service, "?fov_y=90", '{"camera": "roof"}')
    assert answer["distances_m"]["ml"] == pytest.approx(wanted)
    assert stream(service, "?camera=roof", '{"fov_y": 67.5}')["distances_m"]["ml"] == pytest.approx(
        -2
    )


def test_cameras_change_together_with_the_model() -> None:
    """An image that waits during a reload is answered with the new model's cameras."""
    high, gate, committed = replace(ROOF, z=1.75), Gate(), threading.Event()
    expected = decode_outputs(Rectification(high, MODEL).outputs(outputs()[None])[0])
    with (
        serving(gate.engine, cameras={"roof": ROOF}) as service,
        ThreadPoolExecutor(2) as pool,
    ):
        ask = partial(features, query="?camera=roof")
        first = pool.submit(ask, Served(service.port))
        assert gate.busy.wait(PATIENCE_S)
        queue = service.app.frame_queue
        queue.stage_model(constant_engine(), {"roof": high}, committed.is_set)
        second = pool.submit(ask, Served(service.port))
        until(lambda: queue.waiting == 1)
        committed.set()
        gate.open.set()
        answers = [reply.result().content["distances_m"] for reply in (first, second)]
        assert answers == [pytest.approx(EXPECTED.distances_m), pytest.approx(expected.distances_m)]
        model = service.ask("GET", "/model").content
        assert model["cameras"]["roof"]["z"] == 1.75


def test_an_unknown_camera_is_refused(service: Served, engine: FakeEngine) -> None:
    for reply in (
        features(service, "?camera=/etc/hostname"),
        infer(service, camera="../roof"),
    ):
        assert (reply.status, reply.content["type"]) == (422, "/problems/invalid-request")
        assert "the service knows roof" in reply.content["detail"]
    refused = stream(service, "", '{"camera": "cellar"}')
    assert refused["type"] == "/problems/invalid-request"
    both = features(service, "?camera=roof&fov_y=60")
    assert (both.status, "are both given" in both.content["detail"]) == (422, True)
    assert infer(service, camera=7).status == 422
    other = post(service, "/features?camera=roof", JPEG, [("Content-Type", "image/jpeg")])
    assert other.status == 200  # the image has the camera's aspect ratio
    assert len(engine.images) == 1


def test_a_service_without_cameras_says_how_to_give_one(engine: FakeEngine) -> None:
    with serving(engine) as bare:
        reply = features(bare, "?camera=roof")
        assert reply.status == 422
        assert "serve --camera NAME=FILE" in reply.content["detail"]


def test_clients_name_it(service: Served) -> None:
    url = f"http://127.0.0.1:{service.port}"
    with Client(url, timeout_s=PATIENCE_S) as client:
        assert client.features(WIDE, camera="roof")["distances_m"] == pytest.approx(
            EXPECTED.distances_m
        )
        assert client.model()["cameras"] == {"roof": json.loads(json.dumps(ROOF.as_dict()))}
        with pytest.raises(ServiceError, match="the service knows roof"):
            client.features(WIDE, camera="cellar")


def test_cameras_are_read_at_the_start(tmp_path: Path) -> None:
    path = tmp_path / "roof.yaml"
    write_camera(path, ROOF)
    assert read_cameras([f"roof={path}"], MODEL) == {"roof": ROOF}
    task = WorkerTask("run", 0, None, (1,), 2, 3, 4, Limits(), {"roof": ROOF})
    assert WorkerTask.from_json_line(task.to_json_line().decode()).cameras == {"roof": ROOF}
    narrow = tmp_path / "narrow.yaml"
    narrow.write_text("fov_y_deg: 10\n")
    faults: list[tuple[list[str], str]] = [
        (["roof"], "give NAME=FILE"),
        ([f"a b={path}"], "give NAME=FILE"),
        ([f"={path}"], "give NAME=FILE"),
        ([f"roof={path}", f"roof={path}"], "gives roof twice"),
        ([f"roof={tmp_path / 'none.yaml'}"], "cannot be read as a camera"),
        ([f"roof={narrow}"], "shows 13% of the rows of the model's view"),
    ]
    for options, message in faults:
        with pytest.raises(UserError, match=message):
            read_cameras(options, MODEL)


def test_the_maps_of_all_cameras_are_kept_and_their_checks_precede_the_first_frame(
    engine: FakeEngine,
) -> None:
    """A check that is not kept blocks the event loop for about 75 ms."""
    cameras = {str(k): replace(MODEL, z=0.8 + 0.01 * k) for k in range(20)}
    shown_shares.cache_clear()
    loaded = LoadedEngine.of(engine, cameras)
    assert shown_shares.cache_info().misses == len(cameras)
    for name in cameras:
        loaded.rectification(name).check(MODEL.width, MODEL.height)
    assert shown_shares.cache_info().misses == len(cameras)
    assert rectification.KEPT_MAPS >= MAX_CAMERAS
