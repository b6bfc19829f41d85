"""The plan of the paper's protocol: four drives and the rounds of its nine tracks."""

import os
from collections import Counter
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import typer.testing

from datagen.cli import app
from datagen.driving.scripted_driver import ScriptedDriver
from datagen.driving.trajectory import TRAJECTORIES, make_course
from datagen.planning import protocol
from datagen.planning.config import ProtocolConfig
from datagen.planning.protocol import NINE_TRACKS, protocol_plan
from datagen.recording.names import MIDDLE
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World
from trackfeatures.errors import UserError


def test_the_middle_is_the_middle_of_the_middle_lane() -> None:
    """In the mean. A wobble of 0.012 rad over 9 m has 0.012 * 9 * sqrt(2) = 0.153 m; the soft limit
    of a course stretches the middle by 1.1 / tanh(1.1); the mean size is sqrt(2 / pi) of that."""
    expected = (2 / np.pi) ** 0.5 * 0.153 * 1.1 / np.tanh(1.1)
    assert MIDDLE not in TRAJECTORIES  # no training plan changes
    for lanes in (1, 3):
        road = Road(find_track("highway"), lanes)
        offset = make_course(MIDDLE, road, 20_000.0, np.random.default_rng(1)).offset
        assert offset.mean() == pytest.approx(0.0, abs=0.05)
        assert np.abs(offset).mean() == pytest.approx(expected, abs=0.01)


def test_a_drive_takes_as_long_as_its_lap(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the project's own tracks, with the plan's speed of 65 km/h where the bends allow it."""
    monkeypatch.setattr(protocol, "NINE_TRACKS", ("oval", "town"))
    monkeypatch.setattr(protocol, "DRIVEN_TRACKS", ("oval", "coast"))
    plan = protocol_plan(ProtocolConfig(rounds=4, frames=50, laps=0.5), None)
    drives = plan.rounds[4:]
    least = {name: find_track(name).length_m / (65 / 3.6) * 20 / 2 for name in ("oval", "coast")}
    for drive in drives:
        assert least[drive.track] <= drive.frames <= 1.5 * least[drive.track]
        assert (drive.lanes, drive.traffic, drive.trajectory, drive.stretch) == (1, 0, MIDDLE, 0)
        assert (drive.frequency_hz, drive.start, drive.speed_kmh) == (20, 0.0, 65.0)
    assert [(d.track, d.lights, d.split) for d in drives] == [
        ("oval", ("clear",), "test"),
        ("oval", ("heavy-shadow",), "test"),
        ("coast", ("clear",), "unseen"),
        ("coast", ("heavy-shadow",), "unseen"),
    ]
    assert {entry.split for entry in plan.rounds[:4]} == {"test"}
    assert {entry.track for entry in plan.rounds[:4]} == {"oval", "town"}
    assert len({entry.seed for entry in plan.rounds}) == len(plan.rounds)
    assert plan.hash == protocol_plan(ProtocolConfig(rounds=4, frames=50, laps=0.5), None).hash


@pytest.mark.parametrize("laps", [0.0, -1.0, 1001.0, np.inf, np.nan])
def test_impossible_numbers_of_laps_are_refused(laps: float) -> None:
    with pytest.raises(UserError, match=rf"{laps:g} laps asked for; give above 0 to 1000"):
        ProtocolConfig(laps=laps)


def test_a_drive_of_less_than_a_metre_has_a_frame() -> None:
    assert protocol.drive_frames(find_track("oval"), 1e-4, 20) == 1
    for kind in (MIDDLE, *TRAJECTORIES):
        road = Road(find_track("highway"), 1)
        assert len(make_course(kind, road, 0.3, np.random.default_rng(0)).offset) == 2


def test_a_drive_is_one_whole_lap() -> None:
    """Its own course, drawn from the seed of its round, takes as many frames to 0.2 % of a lap."""
    road = Road(find_track("town"), 1)
    frames = protocol.drive_frames(road.track, 1.0, 20)
    course = make_course(MIDDLE, road, 2000.0, np.random.default_rng([1810, 3]))
    driver = ScriptedDriver(road, course, 65 / 3.6)
    places = []
    with World(road) as world:
        state = world.reset(
            seed=1, s=0.0, to_middle=driver.offset_at(0.0), speed=driver.speed_at(0.0)
        )
        for frame in range(frames):
            places.append(state.lap + state.s / road.track.length_m)
            state = world.step(driver.command(state, world.traffic, frame * 65 / 3.6 / 20))
    step = 65 / 3.6 / 20 / road.track.length_m
    assert places[0] == pytest.approx(0.0, abs=1e-5)
    assert places[-1] == pytest.approx(1.0 - step, abs=0.002)
    assert np.diff(places).max() <= 1.01 * step


def test_the_command_records_this_plan(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(protocol, "NINE_TRACKS", ("oval",))
    monkeypatch.setattr(protocol, "DRIVEN_TRACKS", ("oval", "coast"))
    command = import_module("datagen.cli.protocol")  # its attribute of datagen.cli is the function
    recorded: list[tuple[object, ...]] = []
    monkeypatch.setattr(command, "record_plan", lambda *given: recorded.append(given))
    monkeypatch.setattr(command, "print_recorded", lambda result, as_json: None)
    words = ["protocol", "--rounds", "3", "--frames", "7", "--laps", "0.1", "--seed", "5"]
    words += ["--workers", "2", "--out", str(tmp_path)]
    done = typer.testing.CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    ((plan, _, out, workers, *_),) = recorded
    assert (plan, out, workers) == (protocol_plan(ProtocolConfig(3, 7, 0.1, 5), None), tmp_path, 2)


@pytest.mark.skipif("TORCS_TRACKS" not in os.environ, reason="$TORCS_TRACKS is not set")
def test_the_plan_is_as_large_as_the_papers_test_set() -> None:
    plan = protocol_plan(ProtocolConfig(), Path(os.environ["TORCS_TRACKS"]))
    rounds, drives = plan.rounds[:15], plan.rounds[15:]
    assert sum(entry.frames for entry in rounds) == 30_000
    assert {entry.track for entry in rounds} == set(NINE_TRACKS)
    assert set(Counter(entry.lanes for entry in rounds).values()) <= {4, 5, 6}
    assert [(d.track, d.frames) for d in drives] == [
        ("g-track-3", 3453), ("g-track-3", 3453), ("dirt-3", 2701), ("dirt-3", 2701),
    ]  # fmt: skip
