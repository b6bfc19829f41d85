"""Pictures from any thread equal those of the main thread; a forked child gets an error."""

import gc
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from simulator.camera import Camera, Light
from simulator.camera.core.turns import ContextError, ForkedRendererError
from simulator.camera.snapshot import standing_pose
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from trackfeatures.camera import CameraParameters

KINDS = ("clear", "rain", "snow", "heavy-shadow")
PLACES = (10.0, 60.0, 110.0)


@pytest.fixture(scope="module")
def road() -> Road:
    return Road(find_track("oval"), 1)


def open_camera(road: Road, kind: str = "clear", size: tuple[int, int] = (64, 48)) -> Camera:
    light = Light.named(kind, np.random.default_rng(1))
    return Camera(road, CameraParameters(*size), seed=1, light=light)


def take(camera: Camera) -> np.ndarray[Any, Any]:
    """Colours and depths at several places."""
    road = camera.road
    shots = [
        camera.render_views(standing_pose(road, s, 0.5), views=("front", "rear:class"))
        for s in PLACES
    ]
    return np.array([[*shot["front"].ravel(), *shot["rear:class"].ravel()] for shot in shots])


def in_thread(work: Any, *arguments: Any) -> Any:
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(work, *arguments).result(timeout=60)


@pytest.fixture(scope="module")
def expected(road: Road) -> dict[str, np.ndarray[Any, Any]]:
    pictures = {}
    for k, kind in enumerate(KINDS):
        with open_camera(road, kind, (64 + 16 * k, 48)) as camera:
            pictures[kind] = take(camera)
    return pictures


def test_cameras_in_several_threads_at_once(
    road: Road, expected: dict[str, np.ndarray[Any, Any]]
) -> None:
    def work(k: int) -> np.ndarray[Any, Any]:
        with open_camera(road, KINDS[k], (64 + 16 * k, 48)) as camera:
            return take(camera)

    with ThreadPoolExecutor(4) as pool:
        for kind, taken in zip(KINDS, pool.map(work, range(4)), strict=True):
            np.testing.assert_array_equal(taken, expected[kind])


def test_one_camera_in_several_threads_at_once(
    road: Road, expected: dict[str, np.ndarray[Any, Any]]
) -> None:
    camera = in_thread(open_camera, road)
    with ThreadPoolExecutor(4) as pool:
        for taken in pool.map(lambda _: take(camera), range(8)):
            np.testing.assert_array_equal(taken, expected["clear"])
    np.testing.assert_array_equal(take(camera), expected["clear"])
    in_thread(camera.close)
    with pytest.raises(RuntimeError, match="closed"):
        take(camera)


def test_cameras_dropped_in_other_threads_disturb_no_picture(
    road: Road, expected: dict[str, np.ndarray[Any, Any]]
) -> None:
    def drop() -> None:
        for kind in KINDS[:2]:
            take(open_camera(road, kind))
            gc.collect()

    with ThreadPoolExecutor(1) as pool, open_camera(road) as camera:
        dropped = pool.submit(drop)
        while not dropped.done():
            np.testing.assert_array_equal(take(camera), expected["clear"])
        dropped.result()


def test_the_context_of_another_library_stays_current(
    road: Road, expected: dict[str, np.ndarray[Any, Any]]
) -> None:
    def draw_beside_another_context() -> bytes:
        import moderngl

        settings: dict[str, Any] = {"backend": "egl"}
        other = moderngl.create_context(standalone=True, **settings)
        kept = other.buffer(b"its own")
        with open_camera(road) as camera:
            np.testing.assert_array_equal(take(camera), expected["clear"])
        read = kept.read()
        other.release()
        return bytes(read)

    assert in_thread(draw_beside_another_context) == b"its own"


def test_a_context_that_cannot_be_made_current_is_an_error(
    road: Road, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_camera(road) as camera:
        with monkeypatch.context() as patch:
            patch.setattr(camera._graphics.turns._egl, "_make_current", lambda *_: 0)
            with pytest.raises(ContextError, match="made current in this thread"):
                take(camera)
        assert in_thread(take, camera).shape[0] == len(PLACES)  # the lock is free again


def status_of_child(work: Any) -> int:
    """The exit status of a forked child that runs `work`; negative if it had to be killed."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            work()
            status = 0
        finally:
            os._exit(status)
    timer = threading.Timer(240.0, os.kill, (child, 9))
    timer.start()
    _, status = os.waitpid(child, 0)
    timer.cancel()
    return os.waitstatus_to_exitcode(status)


def test_a_forked_child_cannot_draw_and_its_parent_still_can(
    road: Road, expected: dict[str, np.ndarray[Any, Any]]
) -> None:
    with open_camera(road) as camera:

        def in_child() -> None:
            with pytest.raises(ForkedRendererError, match="spawn"):
                take(camera)
            with pytest.raises(ForkedRendererError, match="AsyncVectorEnv"):
                open_camera(road)
            camera.close()
            gc.collect()

        assert status_of_child(in_child) == 0
        # A fork while another thread draws: the child must not wait for that thread's lock.
        with camera._graphics.turns, ThreadPoolExecutor(1) as pool:
            assert pool.submit(status_of_child, in_child).result(timeout=60) == 0
        np.testing.assert_array_equal(take(camera), expected["clear"])


AT_THE_END = """
import os, sys, threading
import numpy as np
from simulator.camera import Camera, Light
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from trackfeatures.camera import CameraParameters
road = Road(find_track("oval"))
light = Light.named("clear", np.random.default_rng(1))
camera = Camera(road, CameraParameters(64, 48), seed=0, light=light)
drawn = threading.Event()
def draw():
    while True:
        camera.render(np.zeros(6))
        drawn.set()
threading.Thread(target=draw, daemon=True).start()
drawn.wait()
child = os.fork()
if child:
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3
sys.exit(3)
"""


@pytest.mark.slow
def test_a_process_ends_while_a_thread_draws() -> None:
    done = subprocess.run(
        [sys.executable, "-c", AT_THE_END], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 3, done.stderr
