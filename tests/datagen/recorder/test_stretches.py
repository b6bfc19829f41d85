"""Each stretch of a round has its own scenery and light, and every frame records its light."""

from pathlib import Path

import numpy as np
import pytest

from datagen.planning.config import CollectConfig, TrackChoice, all_lights
from datagen.planning.planner import make_plan
from datagen.recorder.record import scenery
from datagen.recorder.replay import replay
from datagen.recording import Dataset
from datagen.view.steps import Steps
from tests.datagen.commands import datagen_here

LIGHTS = all_lights()
TRACKS = (TrackChoice("oval", "0"),)


def test_every_light_is_used_before_one_repeats() -> None:
    plan = make_plan(
        CollectConfig(rounds=6, frames=500, seed=3, tracks=TRACKS, stretch=60, scenes=9)
    )
    lights = [light for entry in plan.rounds for light in entry.lights]
    assert [len(entry.lights) for entry in plan.rounds] == [9] * 6
    for first in range(0, len(lights) - len(LIGHTS), len(LIGHTS)):
        assert set(lights[first : first + len(LIGHTS)]) == set(LIGHTS)


def test_by_default_a_round_is_a_film_at_20_hz_in_one_scenery_and_light() -> None:
    plan = make_plan(CollectConfig(rounds=8, frames=500, seed=3, tracks=TRACKS))
    assert [len(entry.lights) for entry in plan.rounds] == [1] * 8
    assert {(entry.stretch, entry.frequency_hz) for entry in plan.rounds} == {(0, 20)}


def test_no_two_stretches_have_the_same_scenery() -> None:
    plan = make_plan(
        CollectConfig(rounds=40, frames=100, seed=3, tracks=TRACKS, stretch=10, scenes=10)
    )
    seen = [scenery(entry, k) for entry in plan.rounds for k in range(10)]
    assert len({seed for seed, _, _ in seen}) == 400
    assert len({(light.exposure, light.haze_per_km) for _, light, _ in seen}) == 400


@pytest.mark.usefixtures("recorded_here")
def test_scenery_and_light_change_where_a_stretch_ends(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    options = ("--rounds", "1", "--frames", "28", "--tracks", "oval", "--lights", "clear,fog")
    done = datagen_here("collect", "--out", folder, *options, "--stretch", "10", "--scenes", "3")
    assert done.returncode == 0, done.stderr
    frames = Dataset.open(folder).select("all")
    assert set(frames.rounds[0].lights) == {"clear", "fog"}
    light = frames.labels.light.tolist()
    assert light == [frames.rounds[0].lights[k // 10] for k in range(28)]
    images = frames.read_batch(range(28)).astype(np.int16)
    change = np.abs(np.diff(images, axis=0)).mean((1, 2, 3))
    assert set(np.argsort(change)[-2:].tolist()) == {9, 19}
    path = frames.rounds[0].path
    assert [step.light for step in Steps.open(path)] == light
    assert replay(folder, 1)[1] == []


@pytest.mark.extended
def test_scenes_repeat_in_order(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    options = ("--rounds", "1", "--frames", "24", "--tracks", "oval", "--lights", "clear,fog")
    done = datagen_here("collect", "--out", folder, *options, "--stretch", "2", "--scenes", "3")
    assert done.returncode == 0, done.stderr
    frames = Dataset.open(folder).select("all")
    lights = frames.rounds[0].lights
    assert len(lights) == 3
    assert frames.labels.light.tolist() == [lights[k // 2 % 3] for k in range(24)]
    # A frame is more similar to the frame of its scene, 6 before it, than to other scenes' frames.
    images = frames.read_batch(range(24)).astype(np.int16)
    for now in range(6, 24):
        apart = [np.abs(images[now] - images[now - back]).mean() for back in (2, 4, 6)]
        assert apart[2] < min(apart[:2])
    assert replay(folder, 1, pixels=True)[1] == []


def test_the_number_of_scenes_is_limited_by_scenes_and_by_stretches() -> None:
    plan = make_plan(
        CollectConfig(rounds=5, frames=500, seed=3, tracks=TRACKS, stretch=20, scenes=7)
    )
    assert [len(entry.lights) for entry in plan.rounds] == [7] * 5
    plan = make_plan(
        CollectConfig(rounds=5, frames=500, seed=3, tracks=TRACKS, stretch=200, scenes=7)
    )
    assert [len(entry.lights) for entry in plan.rounds] == [3] * 5
