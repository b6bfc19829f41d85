"""`Watcher` on a program's own drive: environments, change of road, cost without browsers."""

import json
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import gymnasium
import pytest
import simplejpeg
from websockets.sync.client import ClientConnection, connect

import simulator.env  # noqa: F401 - makes the names known to Gymnasium
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.watch import Watcher
from simulator.watch.pictures import SIZE
from simulator.watch.watcher import Perceived
from simulator.world.world import Command, World
from trackfeatures.errors import UserError


def line(watcher: Watcher) -> AbstractContextManager[ClientConnection]:
    return connect(watcher.url.replace("http", "ws") + "/live", max_size=None)


def read(
    page: ClientConnection, step: Callable[[], object], good: Callable[[Any], bool]
) -> tuple[dict[str, Any], list[bytes], list[dict[str, Any]]]:
    """Step and read until a state is `good`; returns it and the images and scenes before it."""
    pictures: list[bytes] = []
    scenes: list[dict[str, Any]] = []
    end = time.monotonic() + 240.0
    while time.monotonic() < end:
        step()
        try:
            data = page.recv(timeout=0.001)
        except TimeoutError:
            continue
        if isinstance(data, bytes):
            pictures.append(data)
            continue
        message = json.loads(data)
        if message["type"] == "scene":
            scenes.append(message)
            continue
        page.send(json.dumps({"got": message["number"]}))
        if good(message):
            return message, pictures, scenes
    raise AssertionError("nothing good came")


def test_an_environment_is_shown_as_it_is_stepped() -> None:
    env = gymnasium.make("driverview/LateralControl-v0", track="town", lanes=1)
    scores: dict[float, float] = {}

    def step() -> None:
        _, _, ended, cut, info = env.step(env.action_space.sample() * 0.02)
        scores[info["time_s"]] = info["score"]
        if ended or cut:
            env.reset()
        watcher.update(env)

    with Watcher(port=0) as watcher, line(watcher) as page:
        env.reset(seed=1)
        watcher.update(env)
        state, pictures, scenes = read(page, step, lambda m: m["steps"] > 60 and m["episode"] == 1)
        while len(pictures) < 3:
            pictures += read(page, step, lambda _: True)[1]
        env.close()
    assert [scene["track"] for scene in scenes] == ["town"]
    assert scenes[0]["controls"] is False
    assert state["driver"] == "program"
    # The paper's score, as the environment computes it.
    assert state["score"] == pytest.approx(scores[state["time_s"]], abs=0.02)
    assert simplejpeg.decode_jpeg(pictures[-1]).shape == (SIZE[1], SIZE[0], 3)


def test_a_change_of_road_sends_a_new_scene() -> None:
    roads = [Road(find_track(name)) for name in ("oval", "town")]
    with Watcher(port=0) as watcher, line(watcher) as page:
        for episode, road in enumerate(roads, start=1):
            with World(road) as world:
                world.reset(seed=1)

                def step(world: World = world) -> None:
                    world.step(Command(throttle=0.2))
                    watcher.update(world)

                def good(m: dict[str, Any], episode: int = episode) -> bool:
                    return bool(m["episode"] == episode and m["steps"] > 20)

                _, _, scenes = read(page, step, good)
                assert [scene["track"] for scene in scenes] == [road.track.name]


def test_the_drivers_estimate_is_sent_beside_the_true_state() -> None:
    offsets: list[float | None] = []
    with (
        Watcher(port=0, seed=3) as watcher,
        line(watcher) as page,
        World(Road(find_track("oval"))) as world,
    ):
        world.reset(seed=1)
        for known in (Perceived(0.12345, -0.0123456), Perceived(None, 0.0)):

            def step(known: Perceived = known) -> None:
                watcher.update(world, known)

            state, _, _ = read(page, step, lambda m: "perceived" in m)
            while state["perceived"]["angle"] != round(known.angle, 5):
                state, _, _ = read(page, step, lambda m: "perceived" in m)
            offsets.append(state["perceived"]["to_middle"])
        read(page, lambda: watcher.update(world), lambda m: "perceived" not in m)
    assert offsets == [0.123, None]


@pytest.mark.alone
def test_an_update_without_browsers_costs_microseconds() -> None:
    with Watcher(port=0) as watcher, World(Road(find_track("oval"))) as world:
        world.reset(seed=1, speed=15.0)
        watcher.update(world)
        spent = 0.0
        for _ in range(400):
            world.step(Command(throttle=0.2))
            began = time.process_time()
            watcher.update(world)
            spent += time.process_time() - began
    assert spent / 400 < 200e-6


@pytest.mark.alone
def test_speed_paces_the_updates() -> None:
    with Watcher(port=0, speed=10.0) as watcher, World(Road(find_track("oval"))) as world:
        world.reset(seed=1)
        watcher.update(world)
        began = time.monotonic()
        for _ in range(100):  # 5 s
            world.step(Command(throttle=0.2))
            watcher.update(world)
        assert 0.4 < time.monotonic() - began < 4.0


def test_objects_without_a_world_are_refused() -> None:
    with Watcher(port=0) as watcher, pytest.raises(UserError, match="cannot show str"):
        watcher.update("my env")


def test_the_refusal_of_a_vector_environment_names_what_can_be_shown() -> None:
    name = "driverview/LateralControl-v0"
    own: Any = gymnasium.make_vec(name, 2, vectorization_mode="vector_entry_point", track="oval")
    single: Any = gymnasium.make_vec(name, 2, vectorization_mode="sync", track="oval")
    with Watcher(port=0) as watcher:
        for envs in (own, single):
            envs.reset(seed=0)
            with pytest.raises(UserError, match=r"envs\.unwrapped\.world\(0\).*envs\.envs\[0\]"):
                watcher.update(envs)
        watcher.update(own.unwrapped.world(0))
        watcher.update(single.envs[0])
    own.close()
    single.close()


def test_close_frees_the_port_and_a_port_in_use_is_refused() -> None:
    with Watcher(port=0) as watcher:
        port = int(watcher.url.rsplit(":", 1)[1])
        with pytest.raises(UserError, match=f"port {port}: Address already in use"):
            Watcher(port=port)
    Watcher(port=port).close()
